"""Octo small and base 1.5 and models fine-tuned from them, with Octo's own code (JAX)."""

from vlagents_ray.policies.octo.policy import Octo

__all__ = ["Octo"]
