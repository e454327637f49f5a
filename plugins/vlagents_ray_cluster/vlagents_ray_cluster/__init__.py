"""Jobs for clusters: evaluations and servers as Slurm jobs, and the tuner of settings."""
