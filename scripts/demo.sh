#!/usr/bin/env bash
# Install the packages, record three pick episodes, convert them to a dataset with videos, and validate the dataset. At the
# end, print the paths of the files.
#
#   bash scripts/demo.sh [OUT]      # OUT: output folder (default: demo_output); files of an earlier demo are overwritten
set -euo pipefail
out=$(realpath -m "${1:-"$(dirname "${BASH_SOURCE[0]}")/../demo_output"}")
cd "$(dirname "${BASH_SOURCE[0]}")/.."

bash scripts/setup.sh
robocas=${ROBOCAS_VENV:-.venv}/bin/robocas
"$robocas" generate pick -n 3 --seed 0 --out "$out/demonstrations" --overwrite
if ! "${robocas%robocas}python" robocas_ms3/doctor/probes.py render >/dev/null 2>&1; then
    echo "demo: no render device, so the demonstrations cannot be converted to images. Run robocas doctor for advice."
    echo "demonstrations  $out/demonstrations/trajectory.h5"
    exit 0
fi
"$robocas" convert "$out/demonstrations/trajectory.h5" --to robocas --out "$out/dataset" --overwrite
"$robocas" validate "$out/dataset"

echo
echo "demonstrations  $out/demonstrations/trajectory.h5"
echo "dataset         $out/dataset"
for video in "$out"/dataset/preview/episode_*.mp4; do
    echo "video           $video"
done
echo "contact sheet   $out/dataset/preview/contact_sheet.png"
