#!/usr/bin/env bash
# Trains LeRobot's own ACT or diffusion policy, by lerobot-train, on a dataset of `robocas convert --to lerobot`.
#
#   bash scripts/train_lerobot.sh act|diffusion DATASET OUT [STEPS] [--OPTION=VALUE ...]
#
# Options are those of lerobot-train, and win over the sizes below, which suit a CPU: --policy.device=cuda,
# --batch_size=64, --policy.dim_model=512 ... With --no-language as the first of them the policy isn't told what to do.
# An OUT that has a checkpoint goes on from it, to STEPS, with the settings it was begun with.
#
#   OUT/asked     what it was begun with: another policy or dataset is refused
#   OUT/dataset   the dataset as the policy socket shows things (robocas_ms3.baselines.lerobot.prepare)
#   OUT/train     of lerobot-train; scripts/serve_lerobot.sh OUT serves its last checkpoint
#
# Runs in LeRobot's environment, see lerobot_environment.sh.
set -euo pipefail

usage() { sed -n '4p' "$0" >&2; exit 2; }
[ $# -ge 3 ] && [ -f "$2/meta/info.json" ] || usage
kind=$1 dataset=$(cd "$2" && pwd)
mkdir -p "$3"
out=$(cd "$3" && pwd)
shift 3
steps=20000
case ${1:-} in [0-9]*) steps=$1 && shift ;; esac
language=()
if [ "${1:-}" = --no-language ]; then language=(--no-language) && shift; fi
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# Chunks of 2 s at 5 Hz, half of it played. No pretrained weights: nothing is fetched from a hub.
act=(--policy.chunk_size=10 --policy.n_action_steps=5 --policy.dim_model=256 --policy.n_heads=4
    --policy.dim_feedforward=1024 --policy.optimizer_lr=1e-4 --policy.optimizer_lr_backbone=1e-4
    --policy.pretrained_backbone_weights=null)
diffusion=(--policy.horizon=16 --policy.n_obs_steps=2 --policy.n_action_steps=5 '--policy.down_dims=[128,256,512]'
    --policy.noise_scheduler_type=DDIM --policy.num_inference_steps=10 --policy.drop_n_last_frames=10
    --policy.pretrained_backbone_weights=null --policy.use_group_norm=true)
case $kind in
act) sizes=("${act[@]}") ;;
diffusion) sizes=("${diffusion[@]}") ;;
*) usage ;;
esac

asked="$kind $(sha256sum <"$dataset/meta/info.json" | cut -c 1-16) ${language[*]}"
if [ -f "$out/asked" ] && [ "$(cat "$out/asked")" != "$asked" ]; then
    echo "$out: begun as '$(cat "$out/asked")' (policy, dataset, language), not '$asked'. Name another OUT." >&2
    exit 2
fi
if [ -d "$out/dataset" ] && [ ! -f "$out/asked" ]; then
    echo "$out/dataset: of what, is not said. Remove it, or name another OUT." >&2
    exit 2
fi
echo "$asked" >"$out/asked"

. scripts/lerobot_environment.sh
if [ ! -d "$out/dataset" ]; then
    "$venv/bin/python" -m robocas_ms3.baselines.lerobot.prepare "$dataset" "$out/dataset" "${language[@]}"
fi
begun=$out/train/checkpoints/last/pretrained_model/train_config.json
if [ -f "$begun" ]; then
    exec "$venv/bin/lerobot-train" "--config_path=$begun" --resume=true "--steps=$steps" "$@"
fi
if [ -e "$out/train" ]; then # lerobot-train wants to make it
    echo "$out/train: there already, without a checkpoint to go on from. Remove it, or name another OUT." >&2
    exit 2
fi
exec "$venv/bin/lerobot-train" "--policy.type=$kind" "${sizes[@]}" --policy.device=cpu --policy.push_to_hub=false \
    --dataset.repo_id=robocas/train "--dataset.root=$out/dataset" --dataset.video_backend=pyav \
    "--output_dir=$out/train" "--steps=$steps" --batch_size=8 --num_workers=1 --log_freq=10 --save_freq=2000 "$@"
