# Sourced by other scripts: `timed COMMAND VERB ...` runs the command and prints its minutes, or its exit status.
timed() {
    local start=$SECONDS status=0
    "$@" || status=$?
    if ((status)); then
        printf '%s: error: %s exited with status %d; call the script again to continue\n' "$(basename "$0" .sh)" "$2" "$status" >&2
        exit "$status"
    fi
    printf '%s: %s: %d min\n' "$(basename "$0" .sh)" "$2" $(((SECONDS - start + 30) / 60))
}
