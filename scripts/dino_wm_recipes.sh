#!/usr/bin/env bash
# Three recipes of a DINO-WM at equal CPU time, three seeds each, on the recordings of scripts/reproduce_bag.sh: as
# published (concatenation, teacher forcing, every frame, a token a patch), the compact one of version 0.3 (AdaLN, open
# loop, every frame), and that of configs/bag_dino_wm.yaml. Resumable: what exists is skipped.
#   scripts/dino_wm_recipes.sh [OUT]   needs $DATA/bag_whole (latentsafe cache --token_components=0
#     --basis_from=$DATA/bag_tokens), which serves all three, $DATA/held_branches and $DATA/held_lifts with their caches
# Writes results/bag/recipes.json. The steps were chosen so that each takes about as many CPU seconds.
set -euo pipefail
cd "$(dirname "$0")/.."
OUT=${1:-outputs/dino_wm_recipes} DATA=${DATA:-data} SEEDS=${SEEDS:-0 1 2} BIN=.venv/bin
RESULT=${RESULT:-results/bag/recipes.json}
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
mkdir -p "$OUT"
[ -e "$OUT/cost.csv" ] || echo "step,user_s,system_s" >"$OUT/cost.csv"

WHOLE="--policy.world_model.frame_skip=1 --policy.world_model.merge_patches=1 --policy.world_model.frame_token=false
  --policy.world_model.memory=0 --policy.world_model.token_weight=1 --policy.world_model.perception.token_components=0
  --policy.margin.weight=5 --policy.margin.noise=0.5 --policy.optimizer_lr=0.001 --batch_size=16"
PUBLISHED="$WHOLE --policy.world_model.conditioning=concat --policy.world_model.open_loop=0
  --policy.world_model.clip_length=4 --policy.world_model.depth=3 --policy.world_model.decoder_layers=3"
COMPACT="$WHOLE --policy.world_model.clip_length=9 --policy.world_model.dim=96 --policy.world_model.depth=3
  --policy.world_model.heads=3 --policy.world_model.mlp=384 --policy.world_model.observed=3
  --policy.world_model.change_weight=0.7"

recipe() { # name steps seed options...
  local name=$1 steps=$2 seed=$3 cache="$DATA/bag_whole"; shift 3
  local wm="$OUT/wm_${name}_$seed" data="--dataset.repo_id=latentsafe/bag_cache --dataset.root=$cache"
  if [ ! -e "$wm/done" ]; then
    rm -rf "$wm"
    TIMEFORMAT="world_model_${name}_$seed,%U,%S"
    { time $BIN/lerobot-train --config_path=configs/bag_dino_wm.yaml $data --policy.frame_cache="$cache" \
      --output_dir="$wm" --seed="$seed" --steps="$steps" --policy.scheduler_steps="$steps" "$@" 2>&3; } 3>&2 2>>"$OUT/cost.csv"
    touch "$wm/done"
  fi
  [ -e "$OUT/margin_${name}_$seed/integrity.json" ] || $BIN/latentsafe train-margin \
    --policy.path="$wm/checkpoints/last/pretrained_model" $data --output_dir="$OUT/margin_${name}_$seed" --seed="$seed"
}

models=()
for seed in $SEEDS; do
  recipe published "${STEPS_PUBLISHED:-1500}" "$seed" $PUBLISHED
  recipe compact "${STEPS_COMPACT:-500}" "$seed" $COMPACT
  recipe new "${STEPS_NEW:-1050}" "$seed"
  for name in published compact new; do models+=("${name}_$seed=$OUT/margin_${name}_$seed"); done
done
$BIN/python scripts/bag_world_models.py --models "${models[@]}" --data="$DATA" --cost="$OUT/cost.csv" --output="$RESULT"
