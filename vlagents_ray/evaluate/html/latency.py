"""Where the milliseconds went."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from vlagents_ray.evaluate.episode import EpisodeResult
from vlagents_ray.evaluate.html.charts import stacked_bars
from vlagents_ray.evaluate.html.elements import Section, row, section, table, tag
from vlagents_ray.evaluate.html.numbers import number
from vlagents_ray.evaluate.summary import Summary

STAGES = {  # of `act.info["timing"]`, in the order in which a request meets them
    "decode_ms": "decode",
    "queue_ms": "queue",
    "inference_ms": "inference",
    "encode_ms": "encode",
    "wire_ms": "wire",
}
MOST_BARS = 12


def latency(summary: Summary) -> Section | None:
    """One `act` in its stages, and the env's share; None if nothing was played."""
    results = summary.results
    by_name = {name: [one for cell in results.of(name) for one in cell.counted] for name in results.contenders}
    played = {name: counted for name, counted in by_name.items() if counted}
    if not played:
        return None
    stages = {name: _stages(counted) for name, counted in played.items()}
    timed = {name: found for name, found in stages.items() if found}
    bars = dict(list(timed.items())[:MOST_BARS])
    used = [stage for stage in STAGES.values() if any(stage in found for found in stages.values())]
    head = ["Policy, ms", *used, "one act", "its p95", "env step", "env reset", "acts"]
    rows = [
        row(
            name,
            *(number(stages[name].get(stage), 2) for stage in used),
            number(_median(one.policy_ms for one in counted), 2),
            number(_median(one.policy_p95_ms for one in counted), 2),
            number(_median(one.env_step_ms for one in counted), 2),
            number(_median(one.reset_ms for one in counted), 1),
            number(sum(one.acts for one in counted), 0),
        )
        for name, counted in played.items()
    ]
    return section(
        "Latency",
        stacked_bars(bars, "ms", "One act of the policy, by stage") if bars else None,
        table(head, rows, "Latency by stage"),
        tag(
            "p",
            "Medians over the episodes of each episode's median, so that stages need not add up to the whole. Decode, "
            "queue, inference and encode are the server's; wire is what of a round trip was not. "
            f"Transport: {', '.join(summary.transports)}."
            + (f" Drawn: the first {MOST_BARS} of {len(timed)}." if len(timed) > MOST_BARS else ""),
            class_="note",
        ),
    )


def _stages(results: Sequence[EpisodeResult]) -> dict[str, float]:
    found = {}
    for key, stage in STAGES.items():
        spent = _median(one.timing_ms.get(key) for one in results)
        if spent is not None:
            found[stage] = spent
    return found


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
