"""π0, π0-FAST and π0.5 with Physical Intelligence's own code, openpi, in JAX or PyTorch."""

from vlagents_ray.policies.openpi.policy import OpenPi

__all__ = ["OpenPi"]
