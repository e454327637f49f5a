"""Diffusion Policy (Chi et al. 2023, arXiv 2303.04137) with its authors' own code and checkpoints."""

from vlagents_ray.policies.diffusion_policy.policy import DiffusionPolicy

__all__ = ["DiffusionPolicy"]
