"""Some minutes of the simulated day: the faults that its checks detect, and the replay of a
seed.
"""

from __future__ import annotations

import pytest

from tests.simulation import day
from vlagents_ray.robot import MotionLimits

MINUTES = 1 / 60


@pytest.mark.slow
@pytest.mark.parametrize(
    ("relative", "arms"),
    [
        pytest.param(False, 1, id="absolute-1"),
        pytest.param(True, 1, id="relative-1", marks=pytest.mark.integration),
        pytest.param(False, 2, id="absolute-2", marks=pytest.mark.integration),
        pytest.param(True, 2, id="relative-2"),
    ],
)
def test_minutes_with_faults_have_no_jump_and_no_command_after_a_stop(
    relative: bool, arms: int
) -> None:
    normal = day.play_day(0, 2 * MINUTES, faults=False, relative=relative, arms=arms)
    assert normal.stops == 0
    assert normal.moving_s > 100  # of 120 s in total
    assert normal.held.get("dynamics", 0) < 10, (
        "without a fault the guard rejects hardly any of 6000 actions"
    )
    report = day.play_day(
        3, 10 * MINUTES, normal_step=normal.largest_step, relative=relative, arms=arms
    )
    assert report.violations == []
    assert report.stops > 3
    assert report.restarts > 0
    assert report.moving_s > 400
    assert len(report.faults) > 10


@pytest.mark.slow
def test_a_seed_replays_each_command() -> None:
    first, again, other = (day.play_day(seed, 3 * MINUTES) for seed in (1, 1, 2))
    assert first == again
    assert first.digest != other.digest


@pytest.mark.slow
def test_a_guard_without_limits_lets_jumps_through_which_the_day_finds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(day, "LIMITS", MotionLimits())
    report = day.play_day(3, 3 * MINUTES, normal_step=0.02)
    assert any("a step of" in one for one in report.violations)


@pytest.mark.slow
def test_a_restart_from_afar_would_be_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The simulation itself checks this: a watchdog that restarts by itself commands the robot
    without an operator.
    """
    monkeypatch.setattr(day.DayWatchdog, "overdue", lambda self: (self.restart() and None, None))
    report = day.play_day(3, 3 * MINUTES, normal_step=0.02)
    assert any("a command after: stop from afar" in one for one in report.violations)
