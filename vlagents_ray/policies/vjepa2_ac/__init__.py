"""V-JEPA 2-AC (arXiv 2506.09985): plans to a goal image in a learned world model, by the cross-entropy method."""

from vlagents_ray.policies.vjepa2_ac.network import VJepa2AcConfig
from vlagents_ray.policies.vjepa2_ac.policy import VJepa2Ac

__all__ = ["VJepa2Ac", "VJepa2AcConfig"]
