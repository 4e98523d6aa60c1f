#!/usr/bin/env bash
# Audit the results in leaderboard/ that were changed since a commit: check them and replay their stored actions.
#
#   bash scripts/audit_entries.sh COMMIT
#
# The exit status is 1 if a result has problems. A result is changed if one of its files, or the model card of its entry,
# differs from COMMIT.
#
# SAMPLE   number of episodes to replay per result, chosen at random (default: all with stored actions)
# ROBOCAS  robocas command (default: .venv/bin/robocas)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/timed.sh

fail() { printf 'audit_entries: error: %s\n' "$*" >&2; exit 2; }
show_usage "$@"
require_numbers SAMPLE
[[ $# -eq 1 ]] || fail "expected one COMMIT. Usage: bash scripts/audit_entries.sh COMMIT"
git rev-parse --quiet --verify "$1^{commit}" >/dev/null || fail "no such commit: $1"
robocas=${ROBOCAS:-.venv/bin/robocas}

changes=$(mktemp)
trap 'rm -f "$changes"' EXIT
git diff --name-only -z "$1" -- leaderboard/ >"$changes"
git ls-files --others --exclude-standard -z -- leaderboard/ >>"$changes"
declare -A results=()
while IFS= read -r -d '' path; do
    folder=$(dirname "$path")
    while [[ $folder == leaderboard/*/* && ! -f $folder/run.json ]]; do
        folder=$(dirname "$folder")
    done
    # a file of no result, such as a model card: all results of the entry; nothing if the entry was deleted
    [[ $folder != leaderboard/* || ! -d $folder ]] || results[$folder]=1
done <"$changes"
((${#results[@]})) || { echo "audit_entries: no result changed since $1"; exit 0; }
mapfile -t folders < <(printf '%s\n' "${!results[@]}" | sort)
"$robocas" leaderboard audit "${folders[@]}" ${SAMPLE:+--sample "$SAMPLE"}
