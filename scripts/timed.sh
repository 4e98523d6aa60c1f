# Sourced by other scripts: `timed COMMAND VERB ...` runs that, and says how many minutes it took.
timed() {
    local begun=$SECONDS
    "$@"
    printf '%s: %s: %d min\n' "$(basename "$0" .sh)" "$2" $(((SECONDS - begun + 30) / 60))
}
