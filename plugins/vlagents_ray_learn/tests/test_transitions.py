from __future__ import annotations

import copy
import functools
import pickle
import re
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from eval_fakes import LINE, Line, ToZero
from in_process_evaluation import flat_config

from vlagents_ray.envs.base import SequentialBatch
from vlagents_ray.errors import EnvFailed, MissingDependency
from vlagents_ray.evaluate.episode.episode import run_episodes
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job, plan_jobs
from vlagents_ray.evaluate.workers.rollout import Report, Rollout
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.registry import pip_install
from vlagents_ray_learn import rollouts as recording
from vlagents_ray_learn.columns import answers, arrays
from vlagents_ray_learn.rollouts import TransitionRecorder


class Stating(ToZero):
    """Says of its actions what a learner wants to know; `rows` as in the contract of an act's
    log-probability.
    """

    def __init__(self, *, chunk: int = 1, stated: Any = None) -> None:
        super().__init__(chunk)
        self._stated = stated
        self.asked: list[Any] = []
        self.acts = 0

    def act(self, obs: Obs) -> Act:
        self.asked.append(obs.info.get("want"))
        act = super().act(obs)
        act.info["policy"] = {"version": 7 + self.acts}
        self.acts += 1
        if self._stated is not None:
            act.info["behaviour"] = self._stated
        return act


def played(
    agent: Agent,
    env: str = LINE,
    key: EpisodeKey | None = None,
    *,
    execute: int | None = None,
    **options: Any,
) -> Report:
    settings = {"env_options": options.pop("env_options", {}), "execute": execute}
    [case] = plan_cases(flat_config(envs=[env], out="out", **settings))
    worker = Rollout(lambda _: agent, functools.partial(TransitionRecorder, **options))
    [report] = worker.run((Job(key or EpisodeKey(env, 3, 3, case.fingerprint), case),))
    worker.close()
    return report


def transitions(*args: Any, **options: Any) -> tuple[Any, dict[str, np.ndarray]]:
    report = played(*args, **options)
    assert report.failure is None, report.failure
    return report.artifacts.transitions, arrays(report.artifacts.transitions)


def test_the_rows_are_the_steps_of_the_episode() -> None:
    _, got = transitions(ToZero())
    env, agent = Line(), ToZero()
    obs, _ = env.reset(seed=3)
    agent.reset(obs, env.instruction, seed=3)
    for t in range(10):
        act = agent.act(obs)
        np.testing.assert_array_equal(got["state.position"][t], obs.state["position"])
        np.testing.assert_array_equal(got["action"][t], act.rows()[0])
        obs, reward, _, truncated, info = env.step(Act(act.rows()[0]))
        assert got["reward"][t] == np.float32(reward)
        assert (got["success"][t], got["truncated"][t], got["terminated"][t]) == (
            info["success"],
            truncated,
            False,
        )
    np.testing.assert_array_equal(got["final.state.position"], [obs.state["position"]])
    assert got["t"].tolist() == list(range(10))
    assert set(got["key"]) == {
        str(EpisodeKey(LINE, 3, 3, plan_cases(flat_config(envs=[LINE], out="out"))[0].fingerprint))
    }
    assert set(got["episode"]) == {3}
    assert got["instruction"][0].startswith("bring ")
    assert set(got["source"]) == {"policy"}


def test_episodes_side_by_side_have_the_transitions_of_each_by_itself() -> None:
    keys, agent = (
        [EpisodeKey(LINE, seed, seed, "x") for seed in (1, 2, 3)],
        Stating(stated={"value": 1.0}),
    )
    recorders = [TransitionRecorder(None, want=["value"]) for _ in keys]
    results = run_episodes(
        SequentialBatch([Line() for _ in keys]),
        agent,
        [copy.deepcopy(agent) for _ in keys],
        keys,
        observers=recorders,
    )
    for key, recorder, result in zip(keys, recorders, results, strict=True):
        assert isinstance(result, EpisodeResult)
        alone, _ = transitions(Stating(stated={"value": 1.0}), key=key, want=["value"])
        assert recorder.finish(result).transitions.equals(alone)


def test_images_have_a_column_of_their_own_which_may_be_left_out() -> None:
    camera = {"camera": [4, 6]}
    _, got = transitions(ToZero(), env_options=camera)
    assert (got["cameras.front"].shape, got["cameras.front"].dtype) == ((10, 4, 6, 3), np.uint8)
    assert got["cameras.front"][:, 0, 0, 0].tolist() == [20 * t for t in range(10)]
    assert got["final.cameras.front"].shape == (1, 4, 6, 3)
    assert got["final.cameras.front"][0, 0, 0, 0] == 200
    _, without = transitions(ToZero(), env_options=camera, images=False)
    assert set(got) - set(without) == {"cameras.front", "final.cameras.front"}


def test_numbers_and_images_are_views_also_after_a_pickle_that_copies_nothing() -> None:
    batch, got = transitions(ToZero(), env_options={"camera": [32, 32]})
    buffers: list[pickle.PickleBuffer] = []
    message = pickle.dumps(batch, protocol=5, buffer_callback=buffers.append)
    assert len(message) < 10_000 < batch.nbytes, (
        "the rest are buffers, which Ray puts into plasma as they are"
    )
    again = arrays(pickle.loads(message, buffers=buffers))  # noqa: S301
    text = {"key", "instruction", "source"}
    assert [
        name for name in got.keys() - text if not np.shares_memory(got[name], again[name])
    ] == []
    assert [name for name in text if (got[name] != again[name]).any()] == []


def test_an_episode_may_be_longer_than_the_first_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = {"camera": [4, 6]}
    batch, _ = transitions(ToZero(), env_options=camera)
    monkeypatch.setattr(recording, "_FIRST_ROWS", 3)
    assert transitions(ToZero(), env_options=camera)[0].equals(batch)


def test_each_act_is_asked_for_what_is_wanted_and_says_its_version() -> None:
    agent = Stating(chunk=5, stated={"logprob": np.full((5, 1), -0.5), "value": 2.0})
    _, got = transitions(agent, execute=3, want=["logprob", "value"])
    assert agent.asked == [["logprob", "value"]] * 4
    assert got["act"].tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3]
    assert got["version"].tolist() == [7, 7, 7, 8, 8, 8, 9, 9, 9, 10]
    assert got["logprob"].tolist() == [-0.5] * 10
    first = np.diff(got["act"], prepend=-1) == 1
    assert (got["value"][first] == 2.0).all()
    assert np.isnan(got["value"][~first]).all(), "the policy did not see these observations"


@pytest.mark.parametrize(
    ("stated", "rows"),
    [
        (np.full((2, 3), -1.0), [-3.0, -3.0]),  # a number each
        (np.full(2, -1.0), [-1.0, -1.0]),
        (-4.0, [-4.0, np.nan]),  # of the whole chunk
        (np.full(14, -1.0), [-14.0, np.nan]),  # of its tokens
    ],
)
def test_log_probabilities_add_up_to_that_of_the_chunk(stated: Any, rows: list[float]) -> None:
    _, got = transitions(Stating(chunk=2, stated={"logprob": stated}), want=["logprob"])
    np.testing.assert_array_equal(got["logprob"], np.tile(np.float32(rows), 5))


class Replayable(Stating):
    """Has the number of the act in the tokens and the chain of its replay; `later` is the replay
    of the second act.
    """

    def __init__(self, *, chunk: int, later: Any = None) -> None:
        super().__init__(chunk=chunk)
        self._later = later

    def act(self, obs: Obs) -> Act:
        number, act = self.acts, super().act(obs)
        rows = len(act.rows())
        chain = np.full((3, rows, 2), number / 4, np.float32)
        replay = {"tokens": np.full((rows, 1), number), "chain": chain, "noise_level": 0.5}
        act.info["behaviour"] = {
            "replay": self._later if self._later is not None and number == 1 else replay
        }
        return act


def test_the_replay_is_of_the_whole_chunk_once_for_each_answer() -> None:
    agent = Replayable(chunk=5)
    batch, got = transitions(agent, execute=3, want=["replay"])
    assert agent.asked == [["replay"]] * 4
    numbers = np.arange(4)
    np.testing.assert_array_equal(
        got["replay.tokens"], np.broadcast_to(numbers[:, None, None], (4, 5, 1))
    )
    np.testing.assert_array_equal(
        got["replay.chain"], np.broadcast_to(numbers[:, None, None, None] / 4, (4, 3, 5, 2))
    )
    np.testing.assert_array_equal(got["replay.noise_level"], [0.5] * 4)
    assert [got[f"replay.{name}"].dtype for name in ("tokens", "chain", "noise_level")] == [
        np.int64,
        np.float32,
        float,
    ]
    stated = batch.column("replay.noise_level").to_pylist()
    assert stated == [[0.5], [], [], [0.5], [], [], [0.5], [], [], [0.5]], (
        "in the first row of each answer"
    )
    assert all(
        np.shares_memory(got[name], arrays(batch)[name])
        for name in got
        if name.startswith("replay.")
    )


# One answer a step, the last one cut off, one answer an episode.
@pytest.mark.parametrize("chunk", [1, 3, 10])
def test_each_step_of_several_episodes_finds_its_answer(chunk: int) -> None:
    keys = [EpisodeKey(LINE, seed, seed, "x") for seed in (1, 2)]
    batches = [transitions(Replayable(chunk=chunk), key=key, want=["replay"])[0] for key in keys]
    got = arrays(pa.Table.from_batches(batches))
    np.testing.assert_array_equal(got["replay.tokens"][answers(got), 0, 0], got["act"])
    assert len(got["replay.tokens"]) == 2 * -(-10 // chunk)
    assert (got["action"].shape, got["final.state.position"].shape) == ((20, 1), (2, 1))
    assert list(dict.fromkeys(got["key"])) == [f"{LINE}#1@1:x", f"{LINE}#2@2:x"]


@pytest.mark.parametrize(
    ("later", "message"),
    [
        (
            {"tokens": np.zeros((5, 2), np.int64)},
            r"expected \{'chain': .*got \{'tokens': 'int64 \(5, 2\)'\}",
        ),
        (
            {"tokens": "abc"},
            "expected numbers and arrays of numbers by name, got {'tokens': 'abc'}",
        ),
        ([1, 2], r"expected numbers and arrays of numbers by name, got \[1, 2\]"),
        ({}, "expected numbers and arrays of numbers by name, got {}"),
    ],
)
def test_a_replay_that_changes_its_shape_or_has_no_names_is_refused(
    later: Any, message: str
) -> None:
    failure = played(Replayable(chunk=5, later=later), want=["replay"]).failure
    assert failure is not None
    assert (failure.cause, failure.code) == ("user", "config")
    assert re.search(message, failure.message), failure.message


def test_a_policy_that_does_not_return_what_is_wanted_is_a_mistake_in_the_settings() -> None:
    failure = played(Stating(stated={"value": 1.0}), want=["logprob", "value"]).failure
    assert failure is not None
    assert (failure.cause, failure.code) == ("user", "config")
    assert "expected logprob in act.info" in failure.message


def test_an_act_without_a_version_is_of_the_weights_that_the_deployment_loaded() -> None:
    assert set(transitions(ToZero())[1]["version"]) == {0}


def test_an_episode_that_the_policy_broke_off_has_no_transitions() -> None:
    class Nan(ToZero):
        def act(self, obs: Obs) -> Act:
            return Act(np.full(1, np.nan, np.float32))

    report = played(Nan())
    assert report.result is not None
    assert (report.result.status, report.artifacts.transitions) == ("policy_error", None)


def test_an_observation_of_another_shape_is_the_envs_error() -> None:
    one = TransitionRecorder(None)
    one.add_observation(Obs(state={"position": np.zeros(1, np.float32)}))
    with pytest.raises(
        EnvFailed,
        match=r"expected \{'state.position': \(1,\)\} .* got \{'state.position': \(2,\)\}",
    ):
        one.add_observation(Obs(state={"position": np.zeros(2, np.float32)}))


def test_a_key_with_a_seed_of_the_policy_is_another_episode_from_the_same_state() -> None:
    one = EpisodeKey(LINE, 3, 3, "x")
    other = EpisodeKey(LINE, 3, 3, "x", policy_seed=99)
    (_, first), (_, second) = transitions(ToZero(), key=one), transitions(ToZero(), key=other)
    np.testing.assert_array_equal(first["state.position"][0], second["state.position"][0])
    assert (first["action"] != second["action"]).any()
    assert (str(one), str(other)) == (f"{LINE}#3@3:x", f"{LINE}#3@3/99:x")
    assert {
        job.key.policy_seed for job in plan_jobs(plan_cases(flat_config(envs=[LINE], out="out")))
    } == {None}


def test_without_pyarrow_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(
        MissingDependency, match=re.escape(pip_install("rollouts", "vlagents-ray-learn"))
    ):
        TransitionRecorder(None)
