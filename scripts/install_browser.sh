#!/usr/bin/env bash
# Install Debian's Chromium, in which the tests of `robocas view` open the page. The exit status is 0 even if the
# installation fails: without Chromium these tests are skipped. After a failure, later calls do not try again, unless the
# variable `CI` is set.
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
# On Ubuntu the package chromium is a stub that needs snapd.
if ! grep -qsx 'ID=debian' /etc/os-release || [ "$(id -u)" != 0 ] || [ -e "$tried" ]; then exit 0; fi

say "installing chromium for the tests of robocas view"
if { apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium; } >/dev/null 2>&1; then exit 0; fi
touch "$tried"
say "Chromium could not be installed: the tests of robocas view are skipped. Remove $tried to try again."
