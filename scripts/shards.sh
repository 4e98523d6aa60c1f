# Sourced by other scripts: `evaluate FOLDER ARGUMENT ...` runs `robocas eval run ARGUMENT ...` in $jobs shards and merges them
# in FOLDER. A policy decides for all its environments on one core, so shards are faster than several environments.
# The shards and their logs are in FOLDER_shards. An evaluation that has ended is not repeated.
evaluate() {
    local folder=$1 shards=$1_shards folders=() pids=() shard pid status=0
    [[ ! -f $folder/report.md ]] || return 0
    mkdir -p "$shards"
    trap 'kill $(jobs -p) 2>/dev/null || true' EXIT # shards in the background ignore Ctrl-C
    for ((shard = 1; shard < jobs; shard++)); do
        "$robocas" eval run "${@:2}" --shard "$shard/$jobs" --envs 1 --out "$shards/$shard" >"$shards/$shard.log" 2>&1 &
        pids+=($!) folders+=("$shards/$shard")
    done
    timed "$robocas" eval run "${@:2}" --shard "0/$jobs" --envs 1 --out "$shards/0" # with a progress bar
    for pid in "${pids[@]}"; do
        wait "$pid" || status=$?
    done
    ((status == 0)) || fail "a shard failed, see $shards/*.log. Run this script again to continue."
    "$robocas" eval merge "$shards/0" "${folders[@]}" --out "$folder"
}
