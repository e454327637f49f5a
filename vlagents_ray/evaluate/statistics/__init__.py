"""Statistics of success: rates, their paired comparison, and how success comes with time."""

from vlagents_ray.evaluate.statistics.curve import SuccessCurve, success_curve
from vlagents_ray.evaluate.statistics.pairs import Pairs, difference_interval, holm, mcnemar
from vlagents_ray.evaluate.statistics.rates import Z_95, Rate, wilson

__all__ = [
    "Z_95",
    "Pairs",
    "Rate",
    "SuccessCurve",
    "difference_interval",
    "holm",
    "mcnemar",
    "success_curve",
    "wilson",
]
