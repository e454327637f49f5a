"""The reference policy: a small vision-language-action model, trained from scratch on two cores.

Its training is in the folder `examples/reference/` of a checkout. It is also an example for authors
of model families: it has a checkpoint format, a network in torch, and a `ModelPolicy` that uses
them.
"""

from vlagents_ray.policies.reference.policy import Reference

__all__ = ["Reference"]
