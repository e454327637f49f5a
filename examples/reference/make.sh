#!/usr/bin/env bash
# Makes the reference policy from nothing, in runs/reference: demonstrations, datasets, two trainings, evaluation,
# bundles, card. What exists is kept, so that an interrupted run continues. `make reference` calls it.
set -euo pipefail
cd "$(dirname "$0")/../.."
bin=${BIN:-.venv/bin} runs=runs/reference
export PYTHONPATH=examples/reference # the folder of the control, misled.py
# The training's memory is kept, not given back to the system after each step: it takes a fifth of the time.
export MALLOC_ARENA_MAX=1 MALLOC_MMAP_THRESHOLD_=33554432 MALLOC_TRIM_THRESHOLD_=8589934592

# The first training uses demonstrations of both robots, in small lossy video.
for robot in tabletop metaworld; do
  "$bin/vlagents-ray" eval "examples/reference/demonstrations/$robot.yaml" --out "$runs/$robot" --resume
  [ "$robot" = tabletop ] && objects=(--set "environment_state=[puck,target]") || objects=()
  [ -d "$runs/data/$robot" ] ||
    "$bin/vlagents-ray" export "$runs/$robot" --out "$runs/data/$robot" --to lerobot --set successes=true "${objects[@]}"
done
[ -d "$runs/pretrained" ] ||
  "$bin/python" examples/reference/train.py "$runs/data" "$runs/pretrained" --work "$runs/train" --every 2 \
    --cameras tabletop=front,wrist --cameras metaworld=corner2,gripperPOV

# The second training is short. It uses demonstrations of the tabletop whose images keep each pixel. Without it, the
# policy solves 92 instead of 98 % of the episodes from images without losses.
if [ ! -d "$runs/lossless" ]; then
  rm -rf "$runs/recording"
  "$bin/python" examples/reference/dagger.py demonstrate "$runs/recording/tabletop"
  mv "$runs/recording" "$runs/lossless"
fi
[ -d "$runs/checkpoint" ] ||
  "$bin/python" examples/reference/train.py "$runs/lossless" "$runs/checkpoint" --work "$runs/train_lossless" \
    --cameras tabletop=front,wrist --start "$runs/pretrained" --rate 5e-4 --steps 200

evaluations=(tabletop tabletop_misled metaworld metaworld_misled)
for name in "${evaluations[@]}"; do
  "$bin/vlagents-ray" eval "examples/reference/evaluations/$name.yaml" --out "$runs/evaluations/$name" --resume
  "$bin/vlagents-ray" bundle "$runs/evaluations/$name" --out "$runs/checkpoint/$name.bundle.zip"
done
"$bin/python" examples/reference/card.py "$runs/checkpoint" "${evaluations[@]/#/$runs/evaluations/}"
