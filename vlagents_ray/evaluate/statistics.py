"""The old place of `vlagents_ray.evaluate.results.statistics`, kept for those who import it from here."""

from vlagents_ray.errors import deprecated
from vlagents_ray.evaluate.results.statistics import (
    Pairs,
    Rate,
    SuccessCurve,
    difference_interval,
    holm,
    mcnemar,
    success_curve,
    wilson,
)

deprecated("vlagents_ray.evaluate.statistics", "write `from vlagents_ray.evaluate import mcnemar`", since="0.1")

__all__ = ["Pairs", "Rate", "SuccessCurve", "difference_interval", "holm", "mcnemar", "success_curve", "wilson"]
