"""An evaluation ends in time: the episodes that it still begins, and its messages at the end."""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable

import pytest
from eval_fakes import Clock, ToZero
from in_process_evaluation import flat_config

from vlagents_ray.evaluate import EvalConfig, OutOfTime, Progress, evaluate
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase, plan_cases
from vlagents_ray.evaluate.plan.jobs import plan_jobs
from vlagents_ray.evaluate.run import CLOSING_S, MARGIN, Deadline

JOBS = plan_jobs(plan_cases(flat_config(envs=["tabletop"], episodes=3, out="out")))


def test_no_episode_is_begun_that_would_not_end_if_it_were_as_long_as_the_longest() -> None:
    assert (Deadline(None, [1e9]).leaves_room, Deadline(None).is_over) == (True, False)
    for longest, leaves_room in ((90.0, False), (70.0, True)):  # durations of earlier runs
        assert Deadline(100 + CLOSING_S, [20.0, longest], Clock()).leaves_room is leaves_room
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
    assert not deadline.is_over, "running episodes may continue"
    clock.now = 1000
    assert deadline.is_over


class SlowAfterTwo(Progress):
    """After two recorded episodes, the time does not suffice for another one."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._left, self._monkeypatch = 2, monkeypatch

    def episode(self, case: EvalCase, result: EpisodeResult) -> None:
        self._left -= 1
        if not self._left:
            self._monkeypatch.setattr(Deadline, "leaves_room", False)


def test_out_of_time_keeps_what_is_finished_and_resume_plays_the_rest(
    config: Callable[..., EvalConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    play = functools.partial(evaluate, agent_factory=ToZero)
    with pytest.raises(OutOfTime) as stopped:
        play(config(workers=0), end_at=time.time() - 1)
    assert stopped.value.summary.total.episodes == 0
    again = config(workers=0, resume=True)
    with (
        monkeypatch.context() as patch,
        pytest.raises(OutOfTime, match=r"out of time after .* --resume") as stopped,
    ):
        play(again, progress=SlowAfterTwo(patch), end_at=time.time() + 1000)
    assert stopped.value.summary.total.episodes == 2
    assert json.loads((config().out / "summary.json").read_text())["state"] == "out of time"
    summary = play(again, end_at=time.time() + 1000)
    assert (summary.state, summary.total.episodes) == ("complete", 6)
