#!/usr/bin/env bash
# Serves what train_lerobot.sh trained, for `robocas eval pick --policy ws://127.0.0.1:8000 --protocol paper-v1`.
#
#   bash scripts/serve_lerobot.sh OUT [--port 8000] [--device cpu] [--play N]
#
# Runs in LeRobot's environment, see lerobot_environment.sh; nothing of it simulates. Ctrl-C ends it.
set -euo pipefail
[ $# -ge 1 ] && [ -d "$1" ] || { sed -n '4p' "$0" >&2; exit 2; }
run=$(cd "$1" && pwd)
shift
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. scripts/lerobot_environment.sh
exec "$venv/bin/python" -W ignore -m robocas_ms3.baselines.lerobot.serve "$run" "$@"
