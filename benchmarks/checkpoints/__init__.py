"""Checkpoints of random weights with a family's true architecture and size: `python -m
benchmarks.checkpoints`.

`recipes` names the families and writes the deployment file. `pi0`, `lerobot` and `openvla` make the
files of the family with the family's own classes, in its Python environment; they share `tokenizer`
and `weights`.
"""
