"""The reference policy: a small vision-language-action model that is trained from nothing on two
cores.

Its training is in the folder `examples/reference/` of a checkout. It is also the model of a family
for authors of others: a checkpoint, a network in torch, and a `ModelPolicy` around both.
"""

from vlagents_ray.policies.reference.policy import Reference

__all__ = ["Reference"]
