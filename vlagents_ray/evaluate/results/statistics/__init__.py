"""Statistics of success: rates, their paired comparison, and how success comes with time."""

from vlagents_ray.evaluate.results.statistics.pairs import Pairs, difference_interval, holm, mcnemar
from vlagents_ray.evaluate.results.statistics.rates import Z_95, Rate, SuccessCurve, success_curve, wilson

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
