"""Jobs for clusters: evaluations and servers as Slurm jobs, and the tuner, which chooses
settings by measuring.
"""
