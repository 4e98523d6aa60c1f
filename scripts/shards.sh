# Sourced by other scripts: `evaluate FOLDER ARGUMENT ...` runs `robocas eval run ARGUMENT ...` in shards and merges them in
# FOLDER. A policy decides for all its environments on one core, so shards are faster than several environments. The number of
# shards is $jobs, at most $episodes or $EPISODES, so that each shard has episodes. The shards and their logs are in FOLDER_shards; shards that have ended are not repeated.
evaluate() {
    local folder=$1 shards=$1_shards count=$jobs folders=() pids=() shard pid status=0
    local most=${episodes:-${EPISODES:-$count}}
    ((count <= most)) || count=$most
    mkdir -p "$shards"
    trap 'kill $(jobs -p) 2>/dev/null || true' EXIT # shards in the background ignore Ctrl-C
    for ((shard = count - 1; shard >= 0; shard--)); do
        local command=("$robocas" eval run "${@:2}" --backend processes --envs 1 --retry-errors --shard "$shard/$count"
            --out "$shards/$shard")
        folders+=("$shards/$shard")
        if ((shard)); then
            "${command[@]}" >"$shards/$shard.log" 2>&1 &
            pids+=($!)
        else # the last shard shows its progress
            timed "${command[@]}"
        fi
    done
    for pid in "${pids[@]}"; do
        wait "$pid" || status=$?
    done
    ((status == 0)) || fail "a shard failed, or has episodes with an error: see $shards/*.log. Run this script again to continue."
    "$robocas" eval merge "${folders[@]}" --out "$folder" --overwrite
}
