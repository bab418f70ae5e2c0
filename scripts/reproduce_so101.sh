#!/usr/bin/env bash
# The SO-101: its data, two ACT policies, three filters and the comparison, from nothing, resumable: a step whose output
# exists is skipped.
#   scripts/reproduce_so101.sh [OUT]     OUT defaults to outputs/so101; recordings go to data, or to $DATA
# WORLD_MODEL=dino_wm trains the filters on DINO-WMs instead, into outputs/so101_dino_wm, and lets operators push under them.
set -euo pipefail
cd "$(dirname "$0")/.."
WORLD_MODEL=${WORLD_MODEL:-rssm} DATA=${DATA:-data} SEEDS=${SEEDS:-0 1 2}
case $WORLD_MODEL in
  rssm) OUT=${1:-outputs/so101} CACHE="$DATA/so101_cache" PICTURES="" ;;
  dino_wm) OUT=${1:-outputs/so101_dino_wm} CACHE="$DATA/so101_tokens" PICTURES="--encoder=efficientnet_lite0 --image_size=64" ;;
  *) echo "WORLD_MODEL is $WORLD_MODEL; expected rssm or dino_wm" >&2; exit 1 ;;
esac
BIN=.venv/bin
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
mkdir -p "$OUT"
[ -e "$OUT/cost.csv" ] || echo "step,user_s,system_s" >"$OUT/cost.csv"

timed() { # name command... : user and system CPU seconds of the command go to $OUT/cost.csv
  local name=$1; shift
  TIMEFORMAT="$name,%U,%S"
  { time "$@" 2>&3; } 3>&2 2>>"$OUT/cost.csv"
}

record() { # name source seed
  [ -e "$DATA/$1" ] || timed "record_$1" $BIN/latentsafe collect --source="$2" --dataset.repo_id="latentsafe/$1" \
    --dataset.root="$DATA/$1" --seed="$3"
}

merge() { # name sources...
  local name=$1 ids roots; shift
  ids=$(printf "latentsafe/%s, " "$@") roots=$(printf "$DATA/%s, " "$@")
  $BIN/lerobot-edit-dataset --operation.type=merge --new_repo_id="latentsafe/$name" --new_root="$DATA/$name" \
    --operation.repo_ids="[${ids%, }]" --operation.roots="[${roots%, }]"
}

act() { # what it learns from
  [ -e "$OUT/act_$1/checkpoints/last" ] || timed "act_$1" $BIN/lerobot-train --config_path=configs/so101_act.yaml \
    --dataset.repo_id="latentsafe/so101_$1" --dataset.root="$DATA/so101_$1" --output_dir="$OUT/act_$1"
}

filter() { # seed
  local wm="$OUT/wm_$1" data="--dataset.repo_id=latentsafe/so101_cache --dataset.root=$CACHE"
  local trained="$wm/checkpoints/last/pretrained_model"
  [ -e "$wm/checkpoints/last" ] || timed "world_model_$1" $BIN/lerobot-train \
    --config_path="configs/so101_$WORLD_MODEL.yaml" $data --policy.frame_cache="$CACHE" --output_dir="$wm" --seed="$1"
  if [ "$WORLD_MODEL" = dino_wm ]; then
    [ -e "$OUT/margin_$1" ] || timed "margin_$1" $BIN/latentsafe train-margin --policy.path="$trained" $data \
      --output_dir="$OUT/margin_$1" --seed="$1"
    trained="$OUT/margin_$1"
  fi
  [ -e "$OUT/filter_$1" ] || timed "reachability_$1" $BIN/latentsafe train-reachability --policy.path="$trained" $data \
    --output_dir="$OUT/filter_$1" --seeds="[$1]"
}

record so101_reckless so101_reckless 1
record so101_careful so101_careful 2
record so101_mix so101_mix 0
if [ "$WORLD_MODEL" = rssm ]; then
  act reckless
  act careful
fi
[ -e "$DATA/so101" ] || merge so101 so101_mix so101_careful so101_reckless
[ -e "$CACHE" ] || timed cache $BIN/latentsafe cache --dataset.repo_id=latentsafe/so101 --dataset.root="$DATA/so101" \
  --output_dir="$CACHE" $PICTURES
for seed in $SEEDS; do
  filter "$seed"
done
filters=$(for seed in $SEEDS; do echo "$OUT/filter_$seed"; done)
if [ "$WORLD_MODEL" = dino_wm ]; then
  $BIN/python scripts/so101_operators.py --filters $filters
  [ -e "$DATA/so101_mixed" ] || merge so101_mixed so101_careful so101_reckless
  [ -e "$OUT/diffusion_mixed/checkpoints/last" ] || timed diffusion_mixed $BIN/lerobot-train \
    --config_path=configs/so101_diffusion.yaml --dataset.root="$DATA/so101_mixed" --output_dir="$OUT/diffusion_mixed"
  $BIN/python scripts/so101_policies.py --mixed="$OUT/diffusion_mixed/checkpoints/last/pretrained_model" --filters $filters --n=50
  exit 0
fi

policies="$OUT/act_reckless/checkpoints/last/pretrained_model $OUT/act_careful/checkpoints/last/pretrained_model"
$BIN/python scripts/so101_ranges.py --policies $policies --datasets "$DATA/so101_reckless" "$DATA/so101_careful"
$BIN/python scripts/so101_policies.py --reckless=${policies% *} --careful=${policies#* } --filters $filters
$BIN/python scripts/so101_policies.py --reckless=${policies% *} --careful=${policies#* } --filters $filters \
  --law.name=margin --law.epsilon=0 --output=results/so101/margin.json
$BIN/python scripts/so101_faults.py --filter="$OUT/filter_0"
