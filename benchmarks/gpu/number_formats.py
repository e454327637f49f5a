"""Weights and products of 8 bits: their speed, and their error against float32."""

from __future__ import annotations

import importlib.util
from typing import Any, get_args

import numpy as np

from benchmarks.gpu.lab import Lab, row_error
from benchmarks.measured_policy import forget_peak, peak_mib
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.policies.compilation import Quantization

_COUNT = 8  # number of episodes whose first actions are compared
_DYNAMIC = "dynamic"  # part of the names of formats that also compute in 8 bits when compiled


def number_formats(lab: Lab) -> None:
    """π0 in bfloat16 and in each 8-bit format: the time of a call, and the error of actions
    relative to float32; bfloat16 has such an error as well.
    """
    rows: list[dict[str, Any]] = []
    exact = _measure(lab, rows, "float32", {"dtype": "float32"}, None)
    _measure(lab, rows, "bfloat16", {}, exact)
    if importlib.util.find_spec("torchao") is None:
        lab.show(torchao="not installed")
        return
    for kind in get_args(Quantization):
        # A format with 8-bit weights only is captured without compilation; products in 8 bits need
        # the compiler.
        mode = lab.size(True if _DYNAMIC in kind else "graphs", False)
        try:
            _measure(lab, rows, kind, {"quantization": kind, "compile": mode}, exact)
        except VLAgentsError as error:
            rows.append({"numbers": kind, "failed": str(error)[:200]})
            lab.show(number_formats=rows)


def _measure(
    lab: Lab,
    rows: list[dict[str, Any]],
    name: str,
    changed: dict[str, Any],
    exact: np.ndarray | None,
) -> np.ndarray:
    """Load π0, add a row with its figures, and return its actions."""
    sizes = lab.size([1, 8], [1])
    if exact is None:
        sizes = sizes[:1]  # only the actions in float32 are needed, not their speed
    config = {"compile": lab.size("graphs", False), "batch_sizes": sizes, "max_rows": sizes[-1]}
    forget_peak()
    settings = lab.settings(**{**config, **changed})
    with lab.measured(config=settings, largest=sizes[-1]) as measured:
        acts = np.stack(measured.actions(1, lab.size(_COUNT, 2)))
        times = {
            f"{size} rows, ms": measured.bare(size, lab.size(0.5, 0.02))["batch_ms"]
            for size in sizes
        }
        error = 0.0 if exact is None else row_error(acts, exact)
        rows.append(
            {
                "numbers": name,
                "compile": settings["compile"],
                "load_s": measured.load_s,
                **times,
                "error": error,
                "peak_mib": peak_mib(),
            }
        )
        lab.show(number_formats=rows)
    return acts
