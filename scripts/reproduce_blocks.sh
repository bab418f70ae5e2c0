#!/usr/bin/env bash
# Everything of results/blocks from nothing, resumable: what is finished is skipped, what was killed goes on.
#   scripts/reproduce_blocks.sh [--quick] [OUT]     OUT defaults to outputs/blocks; CORES to 2
# --quick runs the whole table small, into OUT/results: its numbers mean nothing.
set -euo pipefail
cd "$(dirname "$0")/.."
quick=; [ "${1:-}" = --quick ] && { quick=1; shift; }
OUT=${1:-outputs/blocks${quick:+_quick}}
BIN=.venv/bin CORES=${CORES:-2}
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1
mkdir -p "$OUT"

training= critic= results=results/blocks n= early=
if [ "$quick" ]; then
  training="--demonstrations=40 --pretraining=300 --steps=600 --n_envs=8 --batch_size=12 --save_every=200"
  critic="--steps=600"
  results="$OUT/results" n="--n=12 --n_curve=4" early="--n=12"
fi

# $training, $critic, $n and $early are lists of options.
# shellcheck disable=SC2086
{
  [ -e "$OUT/dreamer/episodes" ] || OMP_NUM_THREADS=$CORES \
    $BIN/latentsafe train-dreamer --config_path=configs/blocks_dreamer.yaml --output_dir="$OUT/dreamer" $training

  for target in reachability risk; do
    for seed in 0 1 2; do
      [ -e "$OUT/$target/seed_$seed/integrity.json" ] || $BIN/latentsafe train-reachability --seeds="[$seed]" \
        --policy.path="$OUT/dreamer/policy/world_model" --dataset.repo_id=local/blocks_dreamer \
        --dataset.root="$OUT/dreamer/episodes" --output_dir="$OUT/$target/seed_$seed" --target=$target $critic
      # As filters are committed: 16 bits, no decoders. 5 steps were chosen on 40 starts of the curve.
      [ -e "$OUT/$target/final_$seed" ] || $BIN/latentsafe wrap --policy.path="$OUT/$target/seed_$seed" \
        --output_dir="$OUT/$target/final_$seed" --law.proposal_steps=5 --half=true --drawing=false
    done
  done

  $BIN/python scripts/blocks_table2.py --dreamer "$OUT/dreamer/policy" --filters "$OUT"/reachability/final_{0,1,2} \
    --risks "$OUT"/risk/final_{0,1,2} --cells "$OUT/cells.jsonl" --output_dir="$results" --workers="$CORES" $n
  $BIN/python scripts/blocks_warning.py --filter="$OUT/reachability/final_0" --dreamer="$OUT/dreamer/policy" \
    --output="$results/warning.json" --workers="$CORES" $early
  cp "$OUT/dreamer/log.jsonl" "$results/train_dreamer.jsonl"
}
