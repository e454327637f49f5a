"""The figures of the benchmark of an evaluation's overhead, and of the CPU time of other
processes.
"""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from benchmarks.overhead import CpuSampler, Span, measure_overhead, steady
from benchmarks.processes import cpu_seconds
from vlagents_ray.errors import EnvFailed


def test_two_workers_side_by_side() -> None:
    assert steady([Span(0, 10, 100), Span(0, 10, 100)], 2).rate == pytest.approx(20)


def test_a_late_start_and_an_early_end_are_left_out() -> None:
    spans = [Span(0, 10, 100), Span(5, 15, 100)]
    assert steady(spans, 2).rate == pytest.approx(20)


def test_a_gap_between_episodes_counts() -> None:
    spans = [Span(0, 4, 40), Span(6, 10, 40), Span(0, 10, 100)]
    assert steady(spans, 2).rate == pytest.approx(18)


def test_workers_that_never_play_together_are_an_error() -> None:
    with pytest.raises(EnvFailed):
        steady([Span(0, 1, 5), Span(2, 3, 5)], 2)


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.ray
@pytest.mark.alone
def test_it_measures_the_tabletop() -> None:
    for _ in range(5):  # other work of the machine during the bare episodes may distort the result
        found = measure_overhead("tabletop", workers=2, episodes=10, rounds=1)
        if found.ratio < 1 and found.to_json()["median_added_cpu_ms_per_step"] > 0:
            break
    assert len(found.ratios) == 1
    assert 0 < found.ratio < 1
    data = found.to_json()
    assert data["median_ratio"] == found.ratio
    assert data["median_added_cpu_ms_per_step"] > 0
    assert data["bare_cpu_ms_per_step"][0] > 0


BURN = (
    "import sys, time\nwhile time.process_time() < 0.5: pass\nprint(flush=True)\nsys.stdin.read()"
)


@pytest.mark.slow
def test_what_a_process_used_is_counted_and_stays_counted_when_it_has_ended() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", BURN], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as burning:
        assert burning.stdout is not None
        assert burning.stdin is not None
        begun = time.time()
        with CpuSampler(lambda: [burning.pid]) as cpu:
            burning.stdout.readline()
            assert cpu_seconds(burning.pid) >= 0.4
            time.sleep(0.5)  # one or two samples
            burning.stdin.close()
            burning.wait()
            time.sleep(0.5)
        assert cpu.between(begun, time.time()) >= 0.3


def test_a_process_that_is_not_there_is_an_error() -> None:
    with pytest.raises(OSError, match="/proc"):
        cpu_seconds(2**22 + 1)
