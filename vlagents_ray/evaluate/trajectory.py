"""The old place of `vlagents_ray.evaluate.artifacts.trajectory`, kept for those who import it from here."""

from vlagents_ray.errors import deprecated
from vlagents_ray.evaluate.artifacts.trajectory import Trajectory

deprecated("vlagents_ray.evaluate.trajectory", "write `from vlagents_ray.evaluate import Trajectory`", since="0.1")

__all__ = ["Trajectory"]
