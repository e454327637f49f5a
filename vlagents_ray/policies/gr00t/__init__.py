"""GR00T N1.6 and N1.7 with NVIDIA's own code, Isaac-GR00T."""

from vlagents_ray.policies.gr00t.policy import Gr00t

__all__ = ["Gr00t"]
