"""An evaluation ends in time: which episodes it still begins, and what it says in the end."""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import pytest
from eval_fakes import Clock, ToZero
from in_process_evaluation import flat_config

from vlagents_ray.evaluate import EvalConfig, OutOfTime, Progress, evaluate
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase, cells
from vlagents_ray.evaluate.plan.jobs import plan
from vlagents_ray.evaluate.run import CLOSING_S, MARGIN, Deadline

JOBS = plan(cells(flat_config(envs=["tabletop"], episodes=3, out="out")))


def test_without_a_deadline_there_is_always_room() -> None:
    deadline = Deadline(None, [1e9])
    assert deadline.leaves_room
    assert not deadline.is_over


def test_no_episode_is_begun_that_would_not_end_if_it_were_as_long_as_the_longest() -> None:
    clock = Clock()
    deadline = Deadline(1000 + CLOSING_S, now=clock)
    deadline.begin(JOBS[:2])
    clock.now = 100.0
    deadline.end(JOBS[0])
    clock.now = 160.0
    deadline.end(JOBS[1])
    clock.now = 1000 - 160 * MARGIN - 1
    assert deadline.leaves_room
    clock.now = 1000 - 160 * MARGIN
    assert not deadline.leaves_room
    assert not deadline.is_over, "what is being played may go on"
    clock.now = 1000
    assert deadline.is_over


def test_episodes_of_earlier_runs_tell_how_long_they_take() -> None:
    assert not Deadline(100 + CLOSING_S, [20.0, 90.0], Clock()).leaves_room
    assert Deadline(100 + CLOSING_S, [20.0, 70.0], Clock()).leaves_room


class SlowAfterTwo(Progress):
    """Once two episodes are recorded, there is no time for another one."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._left, self._monkeypatch = 2, monkeypatch

    def episode(self, cell: EvalCase, result: EpisodeResult) -> None:
        self._left -= 1
        if not self._left:
            self._monkeypatch.setattr(Deadline, "leaves_room", False)


@pytest.mark.usefixtures("shared_ray")
def test_out_of_time_keeps_what_is_finished_and_resume_plays_the_rest(
    config: Callable[..., EvalConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch, pytest.raises(OutOfTime, match=r"out of time after .* --resume") as stopped:
        evaluate(config(), agent_factory=ToZero, progress=SlowAfterTwo(patch), end_at=time.time() + 1000)
    played = stopped.value.summary.total.episodes
    assert 2 <= played <= 3, "the other worker's episode went on to its end"
    assert json.loads((config().out / "summary.json").read_text())["state"] == "out of time"
    summary = evaluate(config(resume=True), agent_factory=ToZero, end_at=time.time() + 1000)
    assert (summary.state, summary.total.episodes) == ("complete", 6)


@pytest.mark.usefixtures("shared_ray")
def test_an_end_that_is_past_plays_nothing(config: Callable[..., EvalConfig]) -> None:
    with pytest.raises(OutOfTime) as stopped:
        evaluate(config(), agent_factory=ToZero, end_at=time.time() - 1)
    assert stopped.value.summary.total.episodes == 0
