"""Slurm: evaluations and servers as jobs, and the hook for training scripts, which needs the light install only."""

from vlagents_ray.slurm.hook import submit_evaluation

__all__ = ["submit_evaluation"]
