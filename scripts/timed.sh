# Sourced by other scripts: `timed COMMAND VERB ...` runs that, and says how many minutes it took; or that the script can go on.
timed() {
    local begun=$SECONDS status=0
    "$@" || status=$?
    if ((status)); then
        printf '%s: %s ended with %d; what is there is kept, and the same call goes on from it\n' "$(basename "$0" .sh)" "$2" "$status" >&2
        exit "$status"
    fi
    printf '%s: %s: %d min\n' "$(basename "$0" .sh)" "$2" $(((SECONDS - begun + 30) / 60))
}
