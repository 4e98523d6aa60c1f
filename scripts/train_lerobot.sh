#!/usr/bin/env bash
# Train LeRobot's ACT or diffusion policy with lerobot-train on a dataset of `robocas convert --to lerobot`.
#
#   bash scripts/train_lerobot.sh act|diffusion DATASET OUT [STEPS] [--OPTION=VALUE ...]
#
# Options are passed to lerobot-train. They override the small sizes below, which are for a CPU: --policy.device=cuda,
# --batch_size=64, --policy.dim_model=512 and others. With --no-language as the first option, the policy gets no instruction.
# If OUT has a checkpoint, the training continues from this checkpoint to STEPS (default: 20000), with its first settings.
#
#   OUT/settings.txt   policy, dataset and language of the training; a call with other values is an error
#   OUT/dataset        dataset with only the features that a remote policy gets (robocas_ms3.baselines.lerobot.prepare)
#   OUT/train          output of lerobot-train; scripts/serve_lerobot.sh OUT serves the last checkpoint
#
# The training runs in the virtual environment of LeRobot, see lerobot_environment.sh.
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

# Chunks of 2 s at 5 Hz, of which half is executed. No pretrained weights: nothing is downloaded from a model hub.
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

settings="$kind $(sha256sum <"$dataset/meta/info.json" | cut -c 1-16) ${language[*]}"
if [ -f "$out/settings.txt" ] && [ "$(cat "$out/settings.txt")" != "$settings" ]; then
    echo "error: $out has a training with other settings (policy, dataset hash, language): expected" \
        "'$(cat "$out/settings.txt")', found '$settings'. Choose another OUT." >&2
    exit 2
fi
if [ -d "$out/dataset" ] && [ ! -f "$out/settings.txt" ]; then
    echo "error: $out/dataset exists, but $out/settings.txt is missing. Remove the dataset, or choose another OUT." >&2
    exit 2
fi
echo "$settings" >"$out/settings.txt"

. scripts/lerobot_environment.sh
if [ ! -d "$out/dataset" ]; then
    "$venv/bin/python" -m robocas_ms3.baselines.lerobot.prepare "$dataset" "$out/dataset" "${language[@]}"
fi
started=$out/train/checkpoints/last/pretrained_model/train_config.json
if [ -f "$started" ]; then
    exec "$venv/bin/lerobot-train" "--config_path=$started" --resume=true "--steps=$steps" "$@"
fi
if [ -e "$out/train" ]; then # lerobot-train creates this folder
    echo "error: $out/train exists, but has no checkpoint. Remove it, or choose another OUT." >&2
    exit 2
fi
exec "$venv/bin/lerobot-train" "--policy.type=$kind" "${sizes[@]}" --policy.device=cpu --policy.push_to_hub=false \
    --dataset.repo_id=robocas/train "--dataset.root=$out/dataset" --dataset.video_backend=pyav \
    "--output_dir=$out/train" "--steps=$steps" --batch_size=8 --num_workers=1 --log_freq=10 --save_freq=2000 "$@"
