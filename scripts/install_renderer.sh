#!/usr/bin/env bash
# Install Mesa's software Vulkan driver if SAPIEN finds no render device, so that rendering works without a GPU.
#
# SAPIEN 3 needs VK_KHR_external_semaphore_fd, which this driver (lavapipe) has since Mesa 24.3. The exit status is 0 even
# if the installation fails: without a renderer, the package can simulate and record, but not render images.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=${ROBOCAS_SETUP_PYTHON:-.venv/bin/python}
tried=${python%/bin/python}/.robocas-renderer-tried
export DEBIAN_FRONTEND=noninteractive

say() { printf 'setup: %s\n' "$*"; }
renders() { "$python" robocas_ms3/doctor/probes.py render >/dev/null 2>&1; }
advise() {
    say "no render device: $1. Without a render device, everything except images works."
    exit 0
}

# Print the line "URI<tab>signing key or -" of the archive of a suite, such as bookworm, from the apt sources in both formats.
archive_of() {
    local suite=$1 files=()
    shopt -s nullglob
    files=(/etc/apt/sources.list.d/*.sources)
    if [ ${#files[@]} -gt 0 ]; then
        awk -v suite="$suite" '
            function finish() {
                if (types ~ /(^| )deb( |$)/ && (" " suites " ") ~ (" " suite " ") && enabled != "no") {
                    split(uris, uri, " "); print uri[1] "\t" (key == "" ? "-" : key); found = 1; exit
                }
                types = uris = suites = key = enabled = ""
            }
            FNR == 1 { finish() }
            /^[ \t]*$/ { finish(); next }
            /^#/ { next }
            { name = tolower($1); value = $0; sub(/^[^:]*:[ \t]*/, "", value) }
            name == "types:" { types = value }
            name == "uris:" { uris = value }
            name == "suites:" { suites = value }
            name == "enabled:" { enabled = tolower(value) }
            name == "signed-by:" && value ~ /^\// { split(value, keys, " "); key = keys[1] }
            END { if (!found) finish() }
        ' "${files[@]}" | grep . && return
    fi
    files=(/etc/apt/sources.list.d/*.list)
    if [ -f /etc/apt/sources.list ]; then files+=(/etc/apt/sources.list); fi
    [ ${#files[@]} -gt 0 ] || return 1
    awk -v suite="$suite" '
        $1 != "deb" { next }
        {
            key = "-"; line = $0
            if (match(line, /\[[^]]*\]/)) {
                options = substr(line, RSTART + 1, RLENGTH - 2)
                line = substr(line, 1, RSTART - 1) substr(line, RSTART + RLENGTH)
                count = split(options, option, " ")
                for (i = 1; i <= count; i++)
                    if (option[i] ~ /^signed-by=/) { key = substr(option[i], 11); sub(/,.*/, "", key) }
            }
            split(line, field, " ")
            if (field[3] == suite) { print field[2] "\t" key; exit }
        }
    ' "${files[@]}"
}

install_backport() {
    local suite=$1-backports list=/etc/apt/sources.list.d/robocas-backports.list uri key
    if ! archive_of "$suite" | grep -q .; then
        IFS=$'\t' read -r uri key < <(archive_of "$1") || return 1
        if [ "$key" = - ]; then key=; else key="[signed-by=$key] "; fi
        printf 'deb %s%s %s main\n' "$key" "$uri" "$suite" >"$list"
    fi
    if apt-get update -qq && apt-get install -y -qq --no-install-recommends -t "$suite" mesa-vulkan-drivers libvulkan1; then
        return
    fi
    rm -f "$list"
    return 1
}

install_plain() {
    apt-get update -qq && apt-get install -y -qq --no-install-recommends mesa-vulkan-drivers libvulkan1
}

if renders; then exit 0; fi

NEEDED="Vulkan driver: Mesa >= 24.3 (packages mesa-vulkan-drivers and libvulkan1), or the driver of a GPU"
# shellcheck source=/dev/null
system=$(. /etc/os-release 2>/dev/null && echo "${ID:-}-${VERSION_ID:-}") || system=
case $system in
    debian-12) how=backport ;;
    debian-1[3-9] | debian- | ubuntu-2[4-9].*) how=plain ;;
    *) advise "install a $NEEDED" ;;
esac
if [ "$how" = backport ]; then
    command="apt-get install -t bookworm-backports mesa-vulkan-drivers libvulkan1 (with bookworm-backports in the apt sources)"
else
    command="apt-get install mesa-vulkan-drivers libvulkan1"
fi
[ "$(id -u)" = 0 ] || advise "run as root: $command"
[ ! -e "$tried" ] || advise "an earlier installation failed; remove $tried to try again, or install a $NEEDED"

say "no render device: installing Mesa's software Vulkan driver"
log=$(mktemp)
if [ "$how" = backport ]; then install_backport bookworm >"$log" 2>&1 || true; else install_plain >"$log" 2>&1 || true; fi
if renders; then
    say "rendering works: $("$python" robocas_ms3/doctor/probes.py render)"
else
    touch "$tried"
    tail -n 3 "$log"
    rm -f "$log"
    advise "install a $NEEDED"
fi
rm -f "$log"
