#!/usr/bin/env bash
# Serve a policy of train_lerobot.sh, for `robocas eval pick --policy ws://127.0.0.1:8000 --protocol paper-v1`.
#
#   bash scripts/serve_lerobot.sh OUT [--port 8000] [--device cpu] [--n-action-steps N]
#
# The server runs in the virtual environment of LeRobot, see lerobot_environment.sh, without a simulator. Ctrl-C ends it.
set -euo pipefail
[ $# -ge 1 ] && [ -d "$1" ] || { sed -n '4p' "$0" >&2; exit 2; }
run=$(cd "$1" && pwd)
shift
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. scripts/lerobot_environment.sh
exec "$venv/bin/python" -W ignore -m robocas_ms3.baselines.lerobot.serve "$run" "$@"
