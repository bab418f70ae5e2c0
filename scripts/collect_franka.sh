#!/usr/bin/env bash
# Records every dataset of the simulated Franka, resumable: a finished dataset is skipped, a killed one goes on.
#   scripts/collect_franka.sh [OUT]     OUT defaults to data
set -euo pipefail
cd "$(dirname "$0")/.."
OUT=${1:-data}
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
for source in bag_mix bag_branches bag_climbs bag_lifts bag_between bag_dither bag_clumsy bag_middle bag_strong bag_weak bag_mixed blocks_demos blocks_random; do
  [ -e "$OUT/$source" ] && continue
  .venv/bin/latentsafe collect --source="$source" --dataset.repo_id="latentsafe/$source" --dataset.root="$OUT/$source"
done
# Of bags that no other source shows: all sources of one seed start from the same.
[ -e "$OUT/bag_policies" ] || .venv/bin/latentsafe collect --source=bag_policies --dataset.repo_id=latentsafe/bag_policies \
  --dataset.root="$OUT/bag_policies" --seed=23 --dataset.num_episodes=175
[ -e "$OUT/bag_pulls" ] || .venv/bin/latentsafe collect --source=bag_pulls --dataset.repo_id=latentsafe/bag_pulls \
  --dataset.root="$OUT/bag_pulls" --seed=25
[ -e "$OUT/bag_swings" ] || .venv/bin/latentsafe collect --source=bag_swings --dataset.repo_id=latentsafe/bag_swings \
  --dataset.root="$OUT/bag_swings" --seed=53
[ -e "$OUT/bag_retreats" ] || .venv/bin/latentsafe collect --source=bag_retreats --dataset.repo_id=latentsafe/bag_retreats \
  --dataset.root="$OUT/bag_retreats" --seed=31 --dataset.num_episodes=100
# Interrupted where the committed filter would act.
[ -e "$OUT/bag_shielded" ] || .venv/bin/latentsafe collect --source=bag_shielded --dataset.repo_id=latentsafe/bag_shielded \
  --dataset.root="$OUT/bag_shielded" --seed=29 --dataset.num_episodes=100
[ -e "$OUT/bag_varied" ] || .venv/bin/latentsafe collect --source=bag_varied --dataset.repo_id=latentsafe/bag_varied \
  --dataset.root="$OUT/bag_varied" --seed=35
[ -e "$OUT/bag_varied_pulls" ] || .venv/bin/latentsafe collect --source=bag_varied_pulls \
  --dataset.repo_id=latentsafe/bag_varied_pulls --dataset.root="$OUT/bag_varied_pulls" --seed=37
