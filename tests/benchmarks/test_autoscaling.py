"""The timeline of replicas, from numbers made up for it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks.autoscaling import AutoscalingPlan, LoadPhase, ScaleSample, by_second, plot_autoscaling, report

ACTS = [(100.1, 10.0), (100.9, 20.0), (101.5, 30.0)]


def test_acts_are_summed_up_by_the_second() -> None:
    assert by_second(ACTS, 100.0) == [
        {"at": 0.5, "median_ms": 15.0, "p95_ms": 19.5},
        {"at": 1.5, "median_ms": 30.0, "p95_ms": 30.0},
    ]


def test_each_burst_has_its_own_figures_and_times_count_from_the_first(tmp_path: Path) -> None:
    samples = [ScaleSample(99.0, 0, 0, 0), ScaleSample(101.0, 2, 1, 3), ScaleSample(104.0, 4, 4, 1)]
    phases = [
        LoadPhase("robots", 100.0, 102.0, ACTS, 1.5, 0, []),
        LoadPhase("nobody got through", 103.0, 105.0, [], 60.0, 0, ["reset: no replica"]),
    ]
    found = report(AutoscalingPlan(), samples, phases)
    assert [one["at"] for one in found["samples"]] == [-1, 1, 4]
    robots, none = found["phases"]
    assert (robots["begun"], robots["ended"], robots["most_replicas"], robots["acts"]) == (0, 2, 1, 3)
    assert (robots["median_ms"], robots["longest_ms"]) == pytest.approx((20, 30))
    assert none["failed"] == ["reset: no replica"]
    assert math.isnan(none["median_ms"])
    plot_autoscaling(found, tmp_path / "picture.svg")
    assert (tmp_path / "picture.svg").stat().st_size > 1000
