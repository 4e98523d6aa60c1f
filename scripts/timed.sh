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

# `require_numbers NAME ...`: fails if one of these variables is set, but not to a positive integer.
require_numbers() {
    local name
    for name in "$@"; do
        [[ -z ${!name:-} || ${!name} =~ ^[1-9][0-9]*$ ]] || fail "invalid $name: expected a positive integer, found ${!name}."
    done
}

# `show_usage ARGUMENT ...`: prints the first comment of the script and exits if an argument is -h or --help.
show_usage() {
    [[ " $* " == *" -h "* || " $* " == *" --help "* ]] || return 0
    sed -n '2,/^[^#]/{/^[^#]/q;s/^# \{0,1\}//p}' "scripts/$(basename "$0")"
    exit 0
}

# `require_settings FOLDER SETTINGS`: fails if FOLDER was recorded with other settings, which must not be mixed.
require_settings() {
    mkdir -p "$1"
    [[ -f $1/settings.txt ]] || echo "$2" >"$1/settings.txt"
    [[ $(<"$1/settings.txt") == "$2" ]] || fail "$1 was recorded with other settings: expected $(<"$1/settings.txt"), found $2. Choose another FOLDER."
}
