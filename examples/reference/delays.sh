#!/usr/bin/env bash
# Trains the reference policy for late answers, in runs/delays: two rounds, each with corrections by an expert while the
# policy's answers are late, and a training of the head on them. What exists is kept.
set -euo pipefail
cd "$(dirname "$0")/../.."
bin=${BIN:-.venv/bin} runs=runs/delays
export PYTHONPATH=examples/reference # the folder of the expert, reactive.py
start=examples/reference/checkpoint seed=2000000
for round in 1 2; do
  data=$runs/data$round checkpoint=$runs/checkpoint$round
  if [ ! -d "$data" ]; then
    rm -rf "$runs/recording"
    "$bin/python" examples/reference/dagger.py record "$start" "$runs/recording/tabletop" --delay 8 --seed "$seed"
    mv "$runs/recording" "$data"
  fi
  [ -d "$checkpoint" ] ||
    "$bin/python" examples/reference/train.py "$data" "$checkpoint" --work "$runs/train$round" \
      --cameras tabletop=front,wrist --start "$start" --delays 4 --rate 1e-3 --steps 1000
  start=$checkpoint seed=$((seed + 100000))
done
