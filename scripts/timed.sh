# Sourced by other scripts: `timed COMMAND VERB ...` runs the command and prints its duration in minutes. If the command
# fails, it prints an error and exits with the exit status of the command.
timed() {
    local start=$SECONDS status=0
    "$@" || status=$?
    if ((status)); then
        printf '%s: error: robocas %s exited with status %d. Run this script again to continue.\n' "$(basename "$0" .sh)" "$2" "$status" >&2
        exit "$status"
    fi
    printf '%s: %s: %d min\n' "$(basename "$0" .sh)" "$2" $(((SECONDS - start + 30) / 60))
}

# `require_settings FOLDER SETTINGS`: fails if FOLDER was recorded with other settings, which must not be mixed.
require_settings() {
    mkdir -p "$1"
    [[ -f $1/settings.txt ]] || echo "$2" >"$1/settings.txt"
    [[ $(<"$1/settings.txt") == "$2" ]] || fail "$1 was recorded with other settings: expected $(<"$1/settings.txt"), found $2. Choose another FOLDER."
}
