"""The old place of `vlagents_ray.evaluate.results.statistics`, kept for those who import it from here."""

import warnings

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

warnings.warn(
    "vlagents_ray.evaluate.statistics has moved: write `from vlagents_ray.evaluate import mcnemar`",
    DeprecationWarning,
    stacklevel=2,
)

__all__ = ["Pairs", "Rate", "SuccessCurve", "difference_interval", "holm", "mcnemar", "success_curve", "wilson"]
