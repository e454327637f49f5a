#!/usr/bin/env bash
# Train a policy with LeRobot, and watch its checkpoints: each is evaluated as it is written, and the table grows by a row.
#
#   vlagents-ray venv create lerobot   # LeRobot 0.4.4 and this package, in .venv-lerobot, once
#   bash examples/train_and_watch.sh                 # both in a checkout; EPISODES=20 STEPS=200 bash … is a short try
#
# An expert of the built-in tabletop demonstrates, and a small ACT learns from the state alone, in minutes and without a
# GPU. docs/training.md explains the options, docs/tutorials/fine_tune.md has the same with images; demonstrations of a robot
# (`vlagents-ray robot URL --record demos/cups`) take the place of steps 1 and 2.
set -euo pipefail
out=${OUT:-runs/act-state} episodes=${EPISODES:-600} steps=${STEPS:-1000} every=${EVERY:-100} played=${PLAYED:-50}

# 1. Demonstrations: pictures, states and actions of each episode. One puck, as an ACT takes no instruction.
vlagents-ray eval tabletop/lift --policy scripted --episodes "$episodes" --workers 2 --seed 1000 --record all --video none \
  --env-set width=48 --env-set height=48 --env-set pucks=1 --env-set object_state=true --out "$out/demos"

# 2. A dataset without cameras, with the place of the puck as the environment's state.
vlagents-ray export "$out/demos" --out "$out/dataset" --to lerobot --set successes=true --set cut_idle=true \
  --set 'cameras=[]' --set 'state=[xyzrpy,gripper,puck]' --set 'environment_state=[puck]'

# 3. LeRobot's own command trains, in the background, and is ended if this script is.
.venv-lerobot/bin/lerobot-train --dataset.repo_id=local/lift --dataset.root="$out/dataset" --output_dir="$out/train" \
  --policy.type=act --policy.chunk_size=8 --policy.n_action_steps=2 --policy.use_vae=false --policy.dim_model=128 \
  --policy.n_heads=4 --policy.n_encoder_layers=2 --policy.dim_feedforward=256 --policy.dropout=0 \
  --policy.optimizer_lr=5e-4 --policy.push_to_hub=false --batch_size=32 --num_workers=1 \
  --steps="$steps" --save_freq="$every" >"$out/train.log" 2>&1 &
training=$!
trap 'kill $training 2>/dev/null || true' EXIT

# 4. Meanwhile: each checkpoint once it is complete, on seeds that none of the demonstrations had.
vlagents-ray eval tabletop/lift --policy deployments/lerobot.yaml --episodes "$played" --workers 2 \
  --env-set width=48 --env-set height=48 --env-set pucks=1 --env-set object_state=true \
  --set "checkpoint=$out/train/checkpoints/{step}/pretrained_model" --watch "$out/train/checkpoints" --until "$steps" \
  --out "$out/watched"
wait $training
