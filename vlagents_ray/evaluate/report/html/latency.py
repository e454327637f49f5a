"""Where the milliseconds of an answer and of a step went."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.report.html.charts import BarChart, bar_chart
from vlagents_ray.evaluate.results.summary import Summary

STAGES = {  # of `act.info["timing"]`, in the order in which a request meets them
    "decode_ms": "decode",
    "queue_ms": "queue",
    "inference_ms": "inference",
    "encode_ms": "encode",
    "wire_ms": "wire",
}
MOST_BARS = 12


@dataclass(frozen=True, slots=True)
class Latency:
    """One answer of each policy in its stages, and the env's share: medians over the episodes of each one's median."""

    chart: BarChart | None  # None: no server reported its stages
    stages: list[str]  # that any policy has
    rows: list[tuple[str, list[float | None], float | None, int]]  # (policy id, ms, the env's reset in ms, answers)
    transports: list[str]
    timed: int  # policy ids with stages, of which the chart shows the first `MOST_BARS`


def latency(summary: Summary) -> Latency | None:
    """The latencies; None if no episode was played."""
    results = summary.results
    by_name = {name: [one for cell in results.of(name) for one in cell.counted] for name in results.contenders}
    played = {name: counted for name, counted in by_name.items() if counted}
    if not played:
        return None
    spent = {name: _stages(counted) for name, counted in played.items()}
    timed = {name: found for name, found in spent.items() if found}
    bars = dict(list(timed.items())[:MOST_BARS])
    stages = [stage for stage in STAGES.values() if any(stage in found for found in timed.values())]
    rows = [
        (
            name,
            [spent[name].get(stage) for stage in stages]
            + [
                _median(getattr(one, field) for one in counted)
                for field in ("policy_ms", "policy_p95_ms", "env_step_ms")
            ],
            _median(one.reset_ms for one in counted),
            sum(one.acts for one in counted),
        )
        for name, counted in played.items()
    ]
    chart = bar_chart(bars, "One act of the policy, by stage") if bars else None
    return Latency(chart, stages, rows, summary.transports, len(timed))


def _stages(episodes: Sequence[EpisodeResult]) -> dict[str, float]:
    found = {stage: _median(one.timing_ms.get(key) for one in episodes) for key, stage in STAGES.items()}
    return {stage: spent for stage, spent in found.items() if spent is not None}


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
