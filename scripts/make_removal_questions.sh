#!/usr/bin/env bash
# Make the bundled set of removal-order questions: 500 about heaps of 9 objects, 500 about heaps of 15.
#
#   bash scripts/make_removal_questions.sh
#
# After an interruption, run the script again to continue. It measures about 1,500 scenes: 6 hours on one core of an
# Intel Xeon. Result: robocas_ms3/data/removal_questions/removal-order-v1, without images.
#
# OUT      folder of the measured scenes and of the questions with images (default: reproduced/removal_questions)
# SCENES   number of scenes to measure of each kind (default: 800)
# COUNT    number of questions of each kind (default: 500)
# JOBS     number of processes (default: one per core)
# ROBOCAS  robocas command (default: .venv/bin/robocas)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/timed.sh

fail() { printf 'make_removal_questions: error: %s\n' "$*" >&2; exit 2; }
show_usage "$@"
require_numbers SCENES COUNT JOBS
out=${OUT:-reproduced/removal_questions}
scenes=${SCENES:-800} count=${COUNT:-500}
jobs=${JOBS:-$(env -u OMP_NUM_THREADS nproc)}
robocas=${ROBOCAS:-.venv/bin/robocas}

measure() { # exit status 1: some seeds have no scene
    "$robocas" difficulty "${@:3}" --seeds "$2:$(($2 + scenes))" --jobs "$jobs" --out "$out/$1" || [[ $? == 1 ]]
}

measure search_medium 290000 search_table_small_heap --set objects.count=9
measure search_large 292000 search_table_stacked
timed "$robocas" questions make "$out/search_medium" "$out/search_large" --jobs "$jobs" --out "$out/questions"
bundled=robocas_ms3/data/removal_questions/removal-order-v1
mkdir -p "$bundled"
cp "$out/questions/questions.json" "$bundled/"
for kind in search_medium search_large; do
    grep "\"id\": \"$kind-" "$out/questions/questions.jsonl" | head -n "$count"
done >"$bundled/questions.jsonl"
wc -l "$bundled/questions.jsonl"
