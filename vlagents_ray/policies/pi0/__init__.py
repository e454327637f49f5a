"""π0 in Hugging Face transformers."""

from vlagents_ray.policies.pi0.passes import flow_velocity
from vlagents_ray.policies.pi0.policy import Pi0

__all__ = ["Pi0", "flow_velocity"]
