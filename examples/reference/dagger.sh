#!/usr/bin/env bash
# Improves the pretrained reference policy on the tabletop by DAgger, in runs/dagger: corrections by the expert, training
# on them, and both policies on the same 500 seeds, which no episode before had. What exists is kept.
set -euo pipefail
cd "$(dirname "$0")/../.."
bin=${BIN:-.venv/bin} runs=runs/dagger
export MALLOC_ARENA_MAX=1 MALLOC_MMAP_THRESHOLD_=33554432 MALLOC_TRIM_THRESHOLD_=8589934592 # as in make.sh
if [ ! -d "$runs/data" ]; then
  rm -rf "$runs/recording"
  "$bin/python" examples/reference/dagger.py record examples/reference/pretrained "$runs/recording/tabletop"
  mv "$runs/recording" "$runs/data"
fi
[ -d "$runs/checkpoint" ] ||
  "$bin/python" examples/reference/train.py "$runs/data" "$runs/checkpoint" --work "$runs/train" --cameras tabletop=front,wrist \
    --start examples/reference/pretrained --rate 5e-4 --steps 600
"$bin/vlagents-ray" eval examples/reference/evaluations/dagger.yaml --out "$runs/evaluation" --resume
"$bin/python" examples/reference/dagger.py compare "$runs/evaluation"
