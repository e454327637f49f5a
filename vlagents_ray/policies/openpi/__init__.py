"""Physical Intelligence's own code: π0, π0-FAST and π0.5 as openpi trains and saves them, JAX or PyTorch."""

from vlagents_ray.policies.openpi.policy import OpenPi

__all__ = ["OpenPi"]
