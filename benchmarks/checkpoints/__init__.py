"""Checkpoints of random weights with a family's true architecture and size: `python -m
benchmarks.checkpoints`.

`recipes` names the families and writes the deployment file. `pi0`, `lerobot` and `openvla` write
the files of a family with the family's own classes, in the family's Python environment; they share
`tokenizer` and `weights`.
"""
