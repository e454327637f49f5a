"""The old place of `vlagents_ray.evaluate.results.comparison`, kept for those who import it from here."""

from vlagents_ray.errors import deprecated
from vlagents_ray.evaluate.results.comparison import Comparison, compare

deprecated("vlagents_ray.evaluate.comparison", "write `from vlagents_ray.evaluate import compare`", since="0.1")

__all__ = ["Comparison", "compare"]
