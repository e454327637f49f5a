"""Jobs for clusters: evaluations and servers as Slurm jobs."""
