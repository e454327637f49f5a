from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import pytest
from eval_fakes import LINE, OTHER_LINE, SPARING_LINE, Line, SparingLine, ToZero
from in_process_evaluation import flat_config, rollout_by

from vlagents_ray.errors import (
    ConfigError,
    ConnectionLost,
    ContractMismatch,
    DeadlineExceeded,
    EnvFailed,
    InvalidObservation,
    MissingCamera,
    MissingDependency,
    PolicyUnavailable,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray.evaluate import EvalConfig, PolicyConfig
from vlagents_ray.evaluate.artifacts.recorder import Artifacts
from vlagents_ray.evaluate.episode.failures import explain
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job
from vlagents_ray.evaluate.workers import rollout
from vlagents_ray.evaluate.workers.rollout import Report, Rollout
from vlagents_ray.interface import Agent

Config = Callable[..., EvalConfig]


def job(seed: int = 0, env: str = LINE, **settings: Any) -> Job:
    [case] = plan_cases(flat_config(envs=[env], out="out", **settings))
    return Job(EpisodeKey(env, seed, seed, "0"), case)


def rollout_of(config: Config, make: Callable[[], Agent], **changes: Any) -> Rollout:
    return rollout_by(config(**changes), lambda _policy: make())


def played(worker: Rollout, job: Job) -> Report:
    [report] = worker.run((job,))
    return report


def test_the_env_is_made_once_and_closed_when_another_is_needed(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = []
    monkeypatch.setattr(Line, "close", lambda self: closed.append(type(self).__name__))
    worker = rollout_of(config, ToZero)
    reports = [played(worker, one) for one in (job(0), job(1), job(0, OTHER_LINE), job(2))]
    assert [report.env is not None for report in reports] == [True, False, True, True]
    assert closed == ["Line", "OtherLine"]
    worker.close()
    assert closed == ["Line", "OtherLine", "Line"]


def test_after_a_lost_connection_the_next_attempt_has_a_new_agent(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollout, "FIRST_WAIT_S", 0.001)
    agents: list[ToZero] = []
    closed: list[ToZero] = []

    def connect(_policy: PolicyConfig) -> ToZero:
        agents.append(ToZero(lost_on=3 if not agents else None))
        monkeypatch.setattr(
            agents[-1], "close", lambda agent=agents[-1]: closed.append(agent), raising=False
        )
        return agents[-1]

    worker = rollout_by(config(), connect)
    failure = played(worker, job(3)).failure
    assert failure is not None
    assert (failure.cause, failure.code) == ("policy", "connection_lost")
    assert closed == agents[:1]
    assert played(worker, job(3).again()).result is not None
    assert len(agents) == 2


def test_a_policy_that_cannot_start_stops_the_evaluation(config: Config) -> None:
    class Unloadable(ToZero):
        def initialize(self) -> None:
            raise OSError("no such checkpoint")

    failure = played(rollout_of(config, Unloadable), job()).failure
    assert failure is not None
    assert failure.cause == "user"
    assert "no such checkpoint" in failure.message


@pytest.mark.parametrize(
    ("missing", "cause", "code", "said"),
    [
        (None, "worker", EnvFailed.code, "GPU lost"),
        (
            "no Vulkan device; install mesa-vulkan-drivers",
            "user",
            MissingDependency.code,
            "install mesa-vulkan-drivers",
        ),
    ],
)
def test_an_env_that_cannot_be_made_is_an_infrastructure_failure_unless_it_says_what_it_misses(
    config: Config,
    monkeypatch: pytest.MonkeyPatch,
    missing: str | None,
    cause: str,
    code: str,
    said: str,
) -> None:
    monkeypatch.setattr(Line, "missing", classmethod(lambda _cls: missing))
    failure = played(rollout_of(config, ToZero), job(env_options={"broken": "GPU lost"})).failure
    assert failure is not None
    assert (failure.cause, failure.code) == (cause, code)
    assert said in failure.message


def seeds_by_outcome(config: Config, chunk: int) -> dict[bool, list[int]]:
    worker = rollout_of(config, lambda: ToZero(chunk))
    found: dict[bool, list[int]] = {True: [], False: []}
    for seed in range(40):
        result = played(worker, job(seed)).result
        assert result is not None
        found[bool(result.success_once)].append(seed)
    return found


def rendered(
    worker: Rollout, *seeds: int, env: str = SPARING_LINE
) -> tuple[list[int], list[Report]]:
    """Return the number of images that each episode rendered, and the reports."""
    images, reports = [], []
    for seed in seeds:
        before = SparingLine.rendered
        reports.append(played(worker, job(seed, env, env_options={"camera": [32, 32]})))
        images.append(SparingLine.rendered - before)
    return images, reports


@pytest.mark.parametrize("kept", ["video", "record"])
def test_every_frame_is_rendered_as_it_is_played_and_only_failures_are_kept(
    config: Config, kept: str
) -> None:
    """The policy uses observations 1, 4, 7 and 10 of 11, and a recording uses all of them."""
    seeds = seeds_by_outcome(config, chunk=3)
    solved, failed = seeds[True][0], seeds[False][0]
    unrecorded, _ = rendered(rollout_of(config, lambda: ToZero(3)), solved, failed)
    of_failures, [first, second] = rendered(
        rollout_of(config, lambda: ToZero(3), **{kept: "failures"}), solved, failed
    )
    of_all, [_, shown] = rendered(
        rollout_of(config, lambda: ToZero(3), **{kept: "all"}), solved, failed
    )
    assert unrecorded == [4, 4]
    assert of_failures == of_all == [11, 11]
    assert first.artifacts == Artifacts()
    assert second.artifacts == shown.artifacts
    assert second.result is not None
    assert shown.result is not None
    assert second.result.outcome == shown.result.outcome


def test_failures_of_episodes_side_by_side_are_kept(config: Config) -> None:
    class Sessions(ToZero):
        def sessions(self, n: int) -> list[ToZero]:
            return [ToZero(3) for _ in range(n)]

        def act_batch(self, obs: Any, sessions: Any) -> Any:
            return [session.act(one) for session, one in zip(sessions, obs, strict=True)]

    seeds = seeds_by_outcome(config, chunk=3)
    both = [seeds[True][0], seeds[False][0]]
    options = {"env_options": {"camera": [32, 32]}, "num_envs": 2}
    found = {
        video: rollout_of(config, lambda: Sessions(3), video=video).run(
            tuple(job(seed, SPARING_LINE, **options) for seed in both)
        )
        for video in ("failures", "all")
    }
    assert found["failures"][0].artifacts.videos == {}
    assert found["failures"][1].artifacts == found["all"][1].artifacts
    assert found["failures"][1].artifacts.videos


def test_progress_tells_phase_age_and_place(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollout, "LONG_S", 0.0)
    pulses = []

    class Watched(ToZero):
        def act(self, obs: Any) -> Any:
            pulses.append(worker.progress())
            return super().act(obs)

    worker = rollout_of(config, Watched)
    assert worker.progress().phase == "idle"
    played(worker, job())
    assert [(pulse.phase, pulse.steps) for pulse in pulses[:3]] == [
        ("policy act", 0),
        ("policy act", 1),
        ("policy act", 2),
    ]
    assert all(0.0 <= pulse.age_s < 60.0 for pulse in pulses)
    assert sys._getframe().f_code.co_name in pulses[0].stack


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (ContractMismatch("x"), "user"),
        (ConfigError("x"), "user"),
        (MissingCamera("wrist"), "user"),
        (PolicyUnavailable("x"), "policy"),
        (ConnectionLost("x"), "policy"),
        (DeadlineExceeded("x"), "policy"),
        (UnknownSession("x"), "policy"),
        (VLAgentsError("HTTP 500"), "policy"),
        (EnvFailed("x"), "worker"),
        (InvalidObservation("x"), "worker"),
    ],
)
def test_blame_goes_where_something_can_be_done(error: VLAgentsError, cause: str) -> None:
    assert explain(error).cause == cause


def test_what_is_not_installed_is_told_with_the_python_that_lacks_it() -> None:
    assert sys.executable in explain(MissingDependency("'av' is not installed")).message
