#!/usr/bin/env bash
# Installs Debian's Chromium, which the tests of `robocas view` look at its page with. Not an error where it can't be:
# nothing but those tests needs it, and they say that they were skipped. It is tried once; on CI (`CI` is set) each time.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=${ROBOCAS_SETUP_PYTHON:-.venv/bin/python}
tried=${python%/bin/python}/.robocas-browser-tried
export DEBIAN_FRONTEND=noninteractive

case "${CI:-}" in "" | 0 | false) ;; *) rm -f "$tried" ;; esac

say() { printf 'setup: %s\n' "$*"; }

for name in "${ROBOCAS_CHROMIUM:-chromium}" chromium chromium-browser google-chrome google-chrome-stable; do
    if command -v "$name" >/dev/null; then exit 0; fi
done
# Ubuntu's package of this name is a stub that wants snapd.
if ! grep -qsx 'ID=debian' /etc/os-release || [ "$(id -u)" != 0 ] || [ -e "$tried" ]; then exit 0; fi

say "installing chromium for the tests of robocas view"
if { apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium; } >/dev/null 2>&1; then exit 0; fi
touch "$tried"
say "no chromium: the tests of the page will be skipped. Remove $tried to try again."
