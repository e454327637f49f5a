from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest
from in_process_episode import run_episode

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs import EvalEnv
from vlagents_ray.errors import (
    ConnectionLost,
    ContractMismatch,
    EnvFailed,
    InvalidAction,
    PolicyFailed,
    PolicyUnavailable,
    UnknownSession,
)
from vlagents_ray.evaluate.episode.episode import Images
from vlagents_ray.evaluate.episode.failures import explain
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import Act, Agent, Obs

KEY = EpisodeKey("script", 3, 11, "0")


class Script(EvalEnv):
    """An environment that succeeds in the states whose numbers are in `solved`, and stores its
    actions.
    """

    max_steps = 6

    def __init__(
        self, solved: tuple[int, ...] = (), terminates_at: int | None = None, obs: Obs | None = None
    ) -> None:
        self.solved, self.terminates_at = solved, terminates_at
        self.obs = obs or Obs()
        self.actions: list[list[float]] = []
        self.resets: list[tuple[int, Mapping[str, Any] | None]] = []

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=2))

    @property
    def instruction(self) -> str:
        return "do it"

    def reset(
        self, *, seed: int, options: Mapping[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        self.resets.append((seed, options))
        return self.obs, {}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        self.actions.append(act.action.tolist())
        n = len(self.actions)
        return (
            self.obs,
            0.5,
            n == self.terminates_at,
            n == self.max_steps,
            {"success": n in self.solved},
        )

    def close(self) -> None:
        self.actions = []


class Chunks(Agent):
    """A policy that returns the given actions one after another, and stores its observations."""

    def __init__(self, *answers: Any) -> None:
        self.answers: Iterator[Any] = iter(answers)
        self.seen: list[Obs] = []
        self.began: dict[str, Any] = {}

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.began = {"instruction": instruction, **kwargs}
        return {}

    def act(self, obs: Obs) -> Act:
        self.seen.append(obs)
        answer = next(self.answers)
        if isinstance(answer, Exception):
            raise answer
        return answer if isinstance(answer, Act) else Act(np.asarray(answer, np.float32))


ROW = [1.0, 2.0]
CHUNK = [[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]


@pytest.mark.parametrize(
    ("execute", "rows", "acts"), [(None, [1, 2, 3] * 2, 2), (2, [1, 2] * 3, 3)]
)
def test_a_chunk_or_its_first_rows_are_executed_without_asking_again(
    execute: int | None, rows: list[int], acts: int
) -> None:
    env = Script()
    result = run_episode(env, Chunks(CHUNK, CHUNK, CHUNK), KEY, execute=execute)
    assert env.actions == [[row, 0] for row in rows]
    assert (result.steps, result.acts) == (6, acts)


class Endless(Script):
    """An environment that ignores its step limit."""

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        return (*super().step(act)[:3], False, {"success": False})


@pytest.mark.parametrize(
    ("env", "answers", "steps", "ending"),
    [
        # The policy is done after the rows of its chunk.
        (Script(), [ROW, Act(np.asarray(CHUNK, np.float32), done=True)], 4, "policy_done"),
        (Script(terminates_at=2), [CHUNK], 2, "terminated"),  # the episode ends within a chunk
        (Script(), [ROW] * 6, 6, "truncated"),
        (Endless(), [ROW] * 9, 6, "truncated"),
    ],
    ids=["policy", "env", "limit", "forgotten limit"],
)
def test_an_episode_ends_with_the_policy_the_env_or_the_step_limit(
    env: Script, answers: list[Any], steps: int, ending: str
) -> None:
    result = run_episode(env, Chunks(*answers), KEY)
    assert (result.steps, result.ending, result.episode_return) == (steps, ending, 0.5 * steps)


def test_a_further_task_begins_the_policy_anew_in_the_middle_of_a_chunk() -> None:
    class Tasks(Script):
        several_tasks = True

        @property
        def instruction(self) -> str:
            return f"task {len(self.actions) // 2}"

        def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
            seen, *rest = super().step(act)
            return (replace(seen, info={"step": len(self.actions)}), *rest)

    class Told(Chunks):
        def __init__(self, *answers: Any) -> None:
            super().__init__(*answers)
            self.resets: list[tuple[str | None, int]] = []

        def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
            self.resets.append((instruction, obs.info.get("step", 0)))
            return super().reset(obs, instruction, **kwargs)

    env, agent = Tasks(terminates_at=5), Told(CHUNK, CHUNK, CHUNK)
    result = run_episode(env, agent, KEY)
    assert agent.resets == [("task 0", 0), ("task 1", 2), ("task 2", 4)]
    assert [obs.info.get("step", 0) for obs in agent.seen] == [0, 2, 4]
    assert env.actions == [[1, 0], [2, 0]] * 2 + [[1, 0]]
    assert (result.instruction, result.steps, result.ending) == (
        "task 0; task 1; task 2",
        5,
        "terminated",
    )


@pytest.mark.parametrize(
    ("solved", "once", "at_end"),
    [((), False, False), ((2,), True, False), ((2, 6), True, True), ((6,), True, True)],
)
def test_success_once_and_at_the_end_are_told_apart(
    solved: tuple[int, ...], once: bool, at_end: bool
) -> None:
    result = run_episode(Script(solved), Chunks(*[ROW] * 6), KEY)
    assert (result.success_once, result.success_at_end) == (once, at_end)


def test_the_key_decides_both_resets_and_a_remote_policy_is_told_the_contract() -> None:
    class Remote(Chunks):
        metadata: ClassVar[dict[str, Any]] = {}
        transport = "websocket"

    for make in (Chunks, Remote):
        env, agent = Script(), make(*[ROW] * 6)
        result = run_episode(env, agent, KEY, reset_options={"layout": 2})
        assert env.resets == [(11, {"layout": 2})]
        told = agent.began.pop("contract", None)
        assert agent.began == {"instruction": "do it", "seed": 11, "env": "script"}
    assert Contract.from_json(told) == Script().contract
    assert result.transport == "websocket"


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        (RuntimeError("CUDA out of memory"), "policy_failed"),
        ([float("nan"), 0.0], "invalid_action"),
        ([1.0, 2.0, 3.0], "invalid_action"),
        ("none", "policy_failed"),
    ],
)
def test_a_policy_that_fails_ends_its_episode_without_success(answer: Any, code: str) -> None:
    result = run_episode(Script(solved=(1,)), Chunks(ROW, answer), KEY)
    assert (result.status, result.ending, result.steps) == ("policy_error", "error", 1)
    assert (result.success_once, result.success_at_end) == (False, False)
    assert result.error is not None
    assert result.error.startswith(code)


@pytest.mark.parametrize("where", ["step", "contract"])
@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("physics exploded"),
        SystemExit("an asset is missing"),
        PolicyFailed("mine"),
        UnknownSession("who"),
    ],
)
def test_whatever_a_simulator_raises_is_an_env_failure(
    error: BaseException, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(Script, where, property(fail) if where == "contract" else fail)
    with pytest.raises(EnvFailed, match=str(error)):
        run_episode(Script(), Chunks(ROW), KEY)


def test_a_lost_connection_is_no_failure_of_the_policy() -> None:
    with pytest.raises(ConnectionLost):
        run_episode(Script(), Chunks(ROW, ConnectionLost("gone")), KEY)


def test_an_action_that_the_env_refuses_counts_against_the_policy() -> None:
    class Narrow(Script):
        def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
            raise InvalidAction("expected at least 7 numbers, got 2")

    assert run_episode(Narrow(), Chunks(ROW), KEY).status == "policy_error"


JOINTS = {"joints": np.zeros(6, np.float32)}
FRONT = {"front": np.zeros((4, 4, 3), np.uint8)}


class Stated(Script):
    """An environment whose `step` returns `after` from the second step, and whose `reset` returns
    `before`; its contract declares its usual observations.
    """

    def __init__(
        self, *, after: tuple[Any, ...] | None = None, before: Any = None, words: Any = "do it"
    ) -> None:
        super().__init__(obs=Obs(dict(FRONT), 0.5, dict(JOINTS)))
        self.after, self.before, self.words = after, before, words

    @property
    def contract(self) -> Contract:
        return Contract(
            {"front": CameraSpec(4, 4)},
            {"joints": StateSpec(6)},
            gripper=True,
            action=ActionSpec(dim=2),
        )

    @property
    def instruction(self) -> str:
        text: str = self.words
        return text

    def reset(
        self, *, seed: int, options: Mapping[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        answer: tuple[Obs, dict[str, Any]] = self.before or super().reset(seed=seed)
        return answer

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        good = super().step(act)
        return good if self.after is None or len(self.actions) < 2 else self.after  # type: ignore[return-value]


GOOD = Obs(dict(FRONT), 0.5, dict(JOINTS))
SOLVED = {"success": True}


@pytest.mark.parametrize(
    ("obs", "said"),
    [
        (None, "expected an Obs as the observation, got NoneType"),
        ({"joints": 1}, "expected an Obs as the observation, got dict"),
        (Obs(dict(FRONT), 0.5), "state 'joints' is missing"),
        (
            Obs(dict(FRONT), 0.5, {"joints": np.zeros(3, np.float32)}),
            r"expected shape \(6,\), got \(3,\)",
        ),
        (Obs(dict(FRONT), 0.5, {"joints": np.full(6, np.nan, np.float32)}), "finite.*got NaN"),
        (
            Obs(dict(FRONT), None, dict(JOINTS)),
            r"gripper: expected a number in \[0, 1\] where 1 = open, got None",
        ),
        (Obs(dict(FRONT), "open", dict(JOINTS)), r"expected a gripper in \[0, 1\], got 'open'"),  # type: ignore[arg-type]
        (Obs({}, 0.5, dict(JOINTS)), "camera 'front' is missing"),
        (Obs({"front": np.zeros((4, 4), np.uint8)}, 0.5, dict(JOINTS)), "camera 'front': expected"),
        (
            Obs(None, 0.5, dict(JOINTS)),
            "expected a dict as the observation's cameras, got NoneType",
        ),  # type: ignore[arg-type]
        (
            Obs(dict(FRONT), 0.5, dict(JOINTS), info=None),
            "expected a dict as the observation's info, got NoneType",
        ),  # type: ignore[arg-type]
    ],
)
def test_an_observation_that_is_none_is_the_envs_failure_and_never_the_policys(
    obs: Any, said: str
) -> None:
    with pytest.raises(EnvFailed, match=f"env step: .*{said}"):
        run_episode(Stated(after=(obs, 0.0, False, False, SOLVED)), Chunks(*[ROW] * 6), KEY)
    # A first observation of a wrong shape would be wrong again at a second attempt, but a number
    # that is not finite might be correct.
    with pytest.raises(
        EnvFailed if said == "finite.*got NaN" else ContractMismatch, match=f"env reset: .*{said}"
    ):
        run_episode(Stated(before=(obs, {})), Chunks(*[ROW] * 6), KEY)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (
            (GOOD, 0.0, False, False, {"success": "yes"}),
            "expected info\\['success'\\] to be a bool, got 'yes'",
        ),
        (
            (GOOD, 0.0, False, False, {"success": None}),
            "expected info\\['success'\\] to be a bool, got None",
        ),
        (
            (GOOD, 0.0, False, False, {"success": 0.7}),
            "expected info\\['success'\\] to be a bool, got 0.7",
        ),
        ((GOOD, 0.0, False, False, None), "expected an info with 'success', got NoneType"),
        ((GOOD, 0.0, False, False, {}), "expected an info with 'success'"),
        ((GOOD, np.nan, False, False, SOLVED), "expected a finite number as the reward, got nan"),
        ((GOOD, np.inf, False, False, SOLVED), "expected a finite number as the reward, got inf"),
        ((GOOD, 0.0, "no", False, SOLVED), "expected terminated to be a bool, got 'no'"),
        ((GOOD, 0.0, False, [False], SOLVED), "expected truncated to be a bool"),
        ((GOOD, None, False, False, SOLVED), "expected a finite number as the reward, got None"),
        ((GOOD, "1.0", False, False, SOLVED), "expected a finite number as the reward, got '1.0'"),
        ((GOOD, 0.0, False, SOLVED), "expected .*, got a tuple of 4"),
        ((None,), "expected .*, got a tuple of 1"),
    ],
)
def test_what_a_step_returns_is_never_guessed(answer: Any, said: str) -> None:
    with pytest.raises(EnvFailed, match=f"env step: {said}"):
        run_episode(Stated(after=answer), Chunks(*[ROW] * 6), KEY)
    for words in (None, 3):
        with pytest.raises(EnvFailed, match=f"expected the instruction as a str .*, got {words}"):
            run_episode(Stated(words=words), Chunks(ROW), KEY)


def test_an_action_that_an_environment_refuses_at_its_reset_is_its_own_error() -> None:
    """No policy has acted yet, so the episode is repeated, and no other episode ends."""

    class RefusesItsOwn(Stated):
        def reset(self, **options: Any) -> Any:
            raise InvalidAction("action: expected numbers in [-1, 1], got 2")

    with pytest.raises(EnvFailed, match="env reset: InvalidAction: action: expected numbers"):
        run_episode(RefusesItsOwn(), Chunks(ROW), KEY)


@pytest.mark.parametrize("success", [np.True_, 1, 1.0, np.float32(1)])
def test_a_number_that_is_a_bool_is_one(success: Any) -> None:
    after = (GOOD, np.float32(0.5), np.False_, 0, {"success": success})
    result = run_episode(Stated(after=after), Chunks(*[ROW] * 6), KEY)
    assert (result.status, result.success_at_end, result.episode_return) == ("done", True, 3.0)


@pytest.mark.parametrize(
    ("images", "looked_at"),
    [
        ("all", [True] * 6),
        ("requested", [False, False, True, False, False, False]),
        ("none", [False] * 6),
    ],
)
def test_images_may_be_left_out_where_nobody_looks(images: Images, looked_at: list[bool]) -> None:
    told: list[bool] = []

    class Sparing(Stated):
        def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
            told.append(self.looked_at)
            obs, *rest = super().step(act)
            return (obs if self.looked_at else replace(obs, cameras={})), *rest

    assert run_episode(Sparing(), Chunks(CHUNK, CHUNK), KEY, images=images).status == "done"
    assert told == looked_at
    with pytest.raises(EnvFailed, match="camera 'front' is missing"):
        run_episode(
            Stated(after=(replace(GOOD, cameras={}), 0.0, False, False, SOLVED)), Chunks(CHUNK), KEY
        )


def test_the_result_says_which_checkpoint_and_weights_played_and_how_long_each_side_was_busy() -> (
    None
):
    """A server reports the duration of a batch, which is divided among the batch's answers."""

    class Served(Chunks):
        version = 4

        def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
            super().reset(obs, instruction, **kwargs)
            return {"checkpoint": f"runs/{kwargs['checkpoint_step']}"}

        def act(self, obs: Obs) -> Act:
            act = super().act(obs)
            act.info["timing"] = {"inference_ms": 40.0, "batch_size": 4}
            act.info["policy"] = {"version": self.version, "fingerprint": f"digest {self.version}"}
            self.version += 1
            return act

    agent = Served(*[ROW] * 6)
    result = run_episode(Script(), agent, KEY, policy_options={"checkpoint_step": 20})
    assert (agent.began["checkpoint_step"], result.checkpoint) == (20, "runs/20")
    versions = result.first_policy_version, result.policy_version, result.policy_fingerprint
    assert versions == (4, 3 + result.acts, f"digest {3 + result.acts}")
    assert result.policy_seconds == pytest.approx(6 * 0.040 / 4)
    assert result.env_seconds is not None
    assert 0 < result.env_seconds < result.seconds
    unserved = run_episode(Script(), Chunks(*[ROW] * 6), KEY)
    versions = unserved.first_policy_version, unserved.policy_version, unserved.policy_fingerprint
    assert (unserved.checkpoint, *versions) == (None,) * 4


def test_an_episode_with_another_checkpoint_than_that_of_its_case_is_lost_to_infrastructure() -> (
    None
):
    """The server may be loading the case's checkpoint, so the episode is repeated."""

    class Served(Chunks):
        def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
            super().reset(obs, instruction, **kwargs)
            return {"checkpoint": "runs/10"}

    result = run_episode(Script(), Served(*[ROW] * 6), KEY, checkpoint="runs/10")
    assert result.checkpoint == "runs/10"
    with pytest.raises(
        PolicyUnavailable, match="expected an episode with the checkpoint 'runs/20'"
    ):
        run_episode(Script(), Served(*[ROW] * 6), KEY, checkpoint="runs/20")
    assert explain(PolicyUnavailable("reset")).cause == "policy"
    with pytest.raises(PolicyUnavailable, match="got one with None"):
        run_episode(Script(), Chunks(*[ROW] * 6), KEY, checkpoint="runs/20")


def test_a_policy_in_this_process_is_busy_while_it_is_waited_for() -> None:
    class Slow(Chunks):
        def act(self, obs: Obs) -> Act:
            time.sleep(0.005)
            return super().act(obs)

    result = run_episode(Script(), Slow(*[np.zeros(2)] * 6), KEY)
    assert result.policy_seconds is not None
    assert 6 * 0.005 <= result.policy_seconds < result.seconds
