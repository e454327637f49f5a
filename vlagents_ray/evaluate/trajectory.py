"""The old place of `vlagents_ray.evaluate.artifacts.trajectory`, kept for those who import it from here."""

import warnings

from vlagents_ray.evaluate.artifacts.trajectory import Trajectory

warnings.warn(
    "vlagents_ray.evaluate.trajectory has moved: write `from vlagents_ray.evaluate import Trajectory`",
    DeprecationWarning,
    stacklevel=2,
)

__all__ = ["Trajectory"]
