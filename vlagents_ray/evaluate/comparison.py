"""The old place of `vlagents_ray.evaluate.results.comparison`, kept for those who import it from here."""

import warnings

from vlagents_ray.evaluate.results.comparison import Comparison, compare

warnings.warn(
    "vlagents_ray.evaluate.comparison has moved: write `from vlagents_ray.evaluate import compare`",
    DeprecationWarning,
    stacklevel=2,
)

__all__ = ["Comparison", "compare"]
