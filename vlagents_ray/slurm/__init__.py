"""Evaluations and servers as Slurm jobs, and the hook for training scripts, which only needs the light install."""

from vlagents_ray.slurm.training_hook import submit_evaluation

__all__ = ["submit_evaluation"]
