from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, ClassVar

import pytest
from eval_fakes import LINE, OTHER_LINE, Line, ToZero
from flat_config import flat_config

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
from vlagents_ray.evaluate.episode.failures import explain
from vlagents_ray.evaluate.plan.cases import cells
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job
from vlagents_ray.evaluate.workers import rollout
from vlagents_ray.evaluate.workers.rollout import Report, Rollout
from vlagents_ray.interface import Agent

Config = Callable[..., EvalConfig]


def job(seed: int = 0, env: str = LINE, **settings: Any) -> Job:
    [cell] = cells(flat_config(envs=[env], out="out", **settings))
    return Job(EpisodeKey(env, seed, seed, "0"), cell)


def rollout_of(config: Config, make: Callable[[], Agent], **changes: Any) -> Rollout:
    return Rollout(config(**changes), lambda _policy: make())


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


def test_a_worker_reports_what_it_found_out_about_env_and_policy(config: Config) -> None:
    class Remote(ToZero):
        metadata: ClassVar[dict[str, Any]] = {"policy": "to-zero", "checkpoint": "a"}

    worker = rollout_of(config, Remote)
    first, second = played(worker, job(0)), played(worker, job(1))
    assert first.policy == {"policy": "to-zero", "checkpoint": "a"}
    assert first.env is not None
    assert first.env.described == {"simulator": "line", "version": 1}
    assert (second.policy, second.env) == (None, None)


def test_a_contract_mismatch_is_reported_before_any_step_with_every_difference(config: Config) -> None:
    class Picky(ToZero):
        @property
        def contract(self) -> Any:
            from vlagents_ray.contract import ActionSpec, CameraSpec, Contract

            return Contract(cameras={"wrist": CameraSpec()}, action=ActionSpec(dim=7))

        def reset(self, *args: Any, **kwargs: Any) -> Any:
            raise AssertionError

    failure = played(rollout_of(config, Picky), job()).failure
    assert failure is not None
    assert (failure.cause, failure.code) == ("user", ContractMismatch.code)
    assert "camera 'wrist'" in failure.message
    assert "action.dim" in failure.message


def test_after_a_lost_connection_the_next_attempt_has_a_new_agent(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollout, "FIRST_WAIT_S", 0.001)
    agents: list[ToZero] = []
    closed: list[ToZero] = []

    def connect(_policy: PolicyConfig) -> ToZero:
        agents.append(ToZero(lost_on=3 if not agents else None))
        monkeypatch.setattr(agents[-1], "close", lambda agent=agents[-1]: closed.append(agent), raising=False)
        return agents[-1]

    worker = Rollout(config(), connect)
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


def test_an_env_that_cannot_be_made_is_an_infrastructure_failure(config: Config) -> None:
    failure = played(rollout_of(config, ToZero), job(env_options={"broken": "GPU lost"})).failure
    assert failure is not None
    assert (failure.cause, failure.code) == ("worker", EnvFailed.code)
    assert "GPU lost" in failure.message


def test_an_env_that_says_what_it_misses_stops_the_evaluation(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Line, "missing", classmethod(lambda _cls: "no Vulkan device; install mesa-vulkan-drivers"))
    failure = played(rollout_of(config, ToZero), job(env_options={"broken": "no device"})).failure
    assert failure is not None
    assert (failure.cause, failure.code) == ("user", MissingDependency.code)
    assert "install mesa-vulkan-drivers" in failure.message


@pytest.mark.parametrize(("video", "seed", "cameras"), [("none", 0, []), ("failures", 2, []), ("all", 2, ["front"])])
def test_videos_come_as_wanted(config: Config, video: str, seed: int, cameras: list[str]) -> None:
    worker = rollout_of(config, ToZero, video=video)
    report = played(worker, job(seed, env_options={"camera": [32, 32]}))
    assert report.result is not None
    assert sorted(report.artifacts.footage.shown) == cameras


def test_failed_episodes_leave_a_video(config: Config) -> None:
    worker = rollout_of(config, ToZero, video="failures")
    reports = [played(worker, job(seed, env_options={"camera": [32, 32]})) for seed in range(12)]
    for report in reports:
        assert report.result is not None
        assert bool(report.artifacts.footage.shown) != report.result.success_once
    assert {bool(report.artifacts.footage.shown) for report in reports} == {True, False}


def test_progress_tells_phase_age_and_place(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
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
