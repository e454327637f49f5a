"""Gymnasium environments behind the mapping."""

from __future__ import annotations

import itertools
from typing import Any

import gymnasium
import numpy as np
import pytest

from vlagents_ray import Act
from vlagents_ray.envs import make_env
from vlagents_ray.envs.gymnasium import Gymnasium, Pick, as_image, plain
from vlagents_ray.errors import (
    ConfigError,
    EnvFailed,
    InvalidAction,
    MissingDependency,
    NotReset,
    UnknownEnv,
)
from vlagents_ray.testing import ContractViolation, check_env

pytestmark = pytest.mark.sim

PUSHT = "gymnasium/gym_pusht/PushT-v0"


class Arm(gymnasium.Env[dict[str, Any], np.ndarray]):
    """An environment with a nested observation, a gripper in metres, and success after
    three steps.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - Gymnasium declares it so

    def __init__(self, render_mode: str | None = None, broken: bool = False) -> None:
        self.render_mode = render_mode
        self.broken = broken
        box = gymnasium.spaces.Box
        self.action_space = box(np.array([-2.0, 0.0]), np.array([2.0, 1.0]), dtype=np.float64)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "images": gymnasium.spaces.Dict({"top": box(0, 255, (8, 12, 3), np.uint8)}),
                "robot": gymnasium.spaces.Dict({"qpos": box(-9, 9, (4,), np.float64)}),
            }
        )
        self.image = np.zeros((8, 12, 3), np.uint8)
        self.received: np.ndarray | None = None
        self.count = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.count = 0
        self.qpos = np.array([*self.np_random.uniform(-1, 1, 3), 0.02])
        return self.observation(), {"options": options, "env": self}

    def step(self, action: np.ndarray) -> Any:
        if self.broken:
            raise RuntimeError("joint limit")
        self.received = action
        self.count += 1
        self.qpos[:2] += 0.1 * action
        done = self.count >= 3
        return (
            self.observation(),
            np.float64(0.5),
            done,
            False,
            {"task": {"solved": np.bool_(done)}},
        )

    def observation(self) -> dict[str, Any]:
        self.image[:] = self.count  # one buffer for all observations, as in some simulators
        return {"images": {"top": self.image}, "robot": {"qpos": self.qpos}}

    def render(self) -> Any:
        return self.observation()["images"]["top"]


class Switch(Arm):
    """An environment with discrete actions."""

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        self.action_space = gymnasium.spaces.Discrete(2)  # type: ignore[assignment]


@pytest.fixture(autouse=True)
def _registered() -> Any:
    gymnasium.register("VlaArm-v0", entry_point=Arm, max_episode_steps=10)
    gymnasium.register("VlaArmNoLimit-v0", entry_point=Arm)
    gymnasium.register("VlaSwitch-v0", entry_point=Switch, max_episode_steps=10)
    yield
    for name in ("VlaArm-v0", "VlaArmNoLimit-v0", "VlaSwitch-v0"):
        gymnasium.registry.pop(name)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        (
            "gymnasium/Pendulum-v1",
            {"width": 64, "height": 48, "remake": True, "success": "terminated"},
        ),
        (
            "gymnasium/MountainCarContinuous-v0",
            {"max_steps": 20, "unit_actions": True, "success": "terminated"},
        ),
        (PUSHT, {"max_steps": 20}),
        (
            "gymnasium/VlaArm-v0",
            {"success": "task/solved", "gripper": "robot/qpos[3:4]", "gripper_range": (0.0, 0.04)},
        ),
    ],
)
def test_keeps_the_contract(name: str, options: dict[str, Any]) -> None:
    check_env(make_env(name, **options), step_limit="Pendulum" not in name)


def test_a_seed_gives_what_gymnasium_gives_for_it() -> None:
    plain_env = gymnasium.make("Pendulum-v1")
    with make_env("gymnasium/Pendulum-v1") as env:
        for seed in (4, 9, 4):
            expected, _ = plain_env.reset(seed=seed)
            got, _ = env.reset(seed=seed)
            assert np.array_equal(got.state["state"], expected)
            action = np.array([0.7], np.float32)
            assert np.array_equal(
                env.step(Act(action))[0].state["state"], plain_env.step(action)[0]
            )
    plain_env.close()


def test_images_and_vectors_of_the_observation_are_found() -> None:
    with make_env("gymnasium/VlaArm-v0") as env:
        assert list(env.contract.cameras or {}) == ["images/top"]
        assert list(env.contract.state or {}) == ["robot/qpos"]
        assert (env.contract.action.low, env.contract.action.high) == (None, None), (
            "the limits differ by component"
        )


def test_cameras_and_states_are_renamed_cut_and_rendered() -> None:
    options = {
        "cameras": {"front": "images/top", "shown": "render"},
        "state": {"joints": "robot/qpos[0:3]", "last": "robot/qpos[-1:]"},
        "gripper": "robot/qpos[3:4]",
        "gripper_range": [0.0, 0.04],
        "instruction": "reach",
        "control_hz": 5.0,
    }
    with make_env("gymnasium/VlaArm-v0", **options) as env:
        obs, _ = env.reset(seed=1)
        assert sorted(obs.cameras) == ["front", "shown"]
        assert {name: part.shape for name, part in obs.state.items()} == {
            "joints": (3,),
            "last": (1,),
        }
        assert obs.gripper == pytest.approx(0.5)
        assert env.instruction == "reach"
        assert env.contract.instruction is True
        assert env.contract.control_hz == 5.0


def test_unit_actions_are_scaled_to_the_box_and_clipped() -> None:
    with make_env("gymnasium/VlaArm-v0", unit_actions=True) as env:
        env.reset(seed=0)
        inner = env._env.unwrapped  # type: ignore[attr-defined]
        env.step(Act(np.array([0.5, -1.0], np.float32)))
        assert inner.received.tolist() == [1.0, 0.0]
        env.step(Act(np.array([9.0, 9.0], np.float32)))
        assert inner.received.tolist() == [2.0, 1.0]
        assert inner.received.dtype == np.float64


@pytest.mark.parametrize(
    ("options", "solved"),
    [({"success": "task/solved"}, True), ({"success": "terminated"}, True)],
)
def test_success_comes_from_where_the_option_says(options: dict[str, str], solved: bool) -> None:
    with make_env("gymnasium/VlaArm-v0", **options) as env:
        env.reset(seed=0)
        assert [env.step(Act(np.zeros(2, np.float32)))[-1]["success"] for _ in range(3)][
            -1
        ] is solved


def test_an_episode_without_a_word_of_success_is_an_error_at_its_end() -> None:
    cure = r"'is_success' or 'success' in the info .* with \['task'\]; set `success` in env_options"
    for max_steps in (10, 2):  # the simulator ends the episode, or the step limit does
        with make_env("gymnasium/VlaArm-v0", max_steps=max_steps) as env:
            env.reset(seed=0)
            for _ in range(min(3, max_steps) - 1):
                env.step(Act(np.zeros(2, np.float32)))
            with pytest.raises(ConfigError, match=cure):
                env.step(Act(np.zeros(2, np.float32)))
    with pytest.raises(ConfigError, match=cure):
        check_env(make_env("gymnasium/VlaArm-v0"))
    with pytest.raises(ConfigError, match="expected 'is_success' or 'success'"):
        check_env(make_env("gymnasium/MountainCarContinuous-v0", max_steps=20))


@pytest.mark.parametrize("key", ["is_success", "success"])
@pytest.mark.parametrize("value", [True, False, 1, 0.0, np.float32(1), np.array([False])])
@pytest.mark.parametrize("at", ["each", "last"])
def test_success_may_be_in_one_info_of_an_episode(
    key: str, value: Any, at: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with make_env("gymnasium/VlaArm-v0") as env:
        real = Arm.step

        def step(arm: Arm, action: np.ndarray) -> Any:
            *outputs, info = real(arm, action)
            return *outputs, info | ({key: value} if at == "each" or arm.count == 3 else {})

        monkeypatch.setattr(Arm, "step", step)
        env.reset(seed=0)
        for _ in range(3):
            *_, info = env.step(Act(np.zeros(2, np.float32)))
        assert info["success"] is bool(value)


@pytest.mark.parametrize("value", [0.7, 2, "no", None, np.array([True, False]), float("nan")])
def test_a_score_or_a_text_is_no_success(value: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Arm.step
    monkeypatch.setattr(
        Arm, "step", lambda arm, act: (*real(arm, act)[:4], {"success": value, "won": value})
    )
    for options in ({}, {"success": "won"}):
        with make_env("gymnasium/VlaArm-v0", **options) as env:
            env.reset(seed=0)
            with pytest.raises(ConfigError, match="expected a bool in the info"):
                env.step(Act(np.zeros(2, np.float32)))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"success": "solved"}, ConfigError, "'solved'"),
        ({"kwargs": {"broken": True}}, EnvFailed, "joint limit"),
    ],
)
def test_what_a_simulator_does_not_give_is_no_failure_of_the_policy(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with make_env("gymnasium/VlaArm-v0", **options) as env:
        env.reset(seed=0)
        with pytest.raises(error, match=message):
            env.step(Act(np.zeros(2, np.float32)))


def test_an_env_without_step_limit_asks_for_one() -> None:
    with pytest.raises(ConfigError, match="max_steps"):
        make_env("gymnasium/VlaArmNoLimit-v0")
    with make_env("gymnasium/VlaArmNoLimit-v0", max_steps=7) as env:
        assert env.max_steps == 7


@pytest.mark.parametrize(
    ("task", "options", "error", "message"),
    [
        ("NoSuchEnv-v0", {}, UnknownEnv, "NoSuchEnv"),
        (
            "gymnasium/VlaArm-v0",
            {},
            UnknownEnv,
            "gymnasium/MODULE:ID imports.*did you mean 'VlaArm-v0'",
        ),
        (None, {}, UnknownEnv, "Pendulum"),
        ("VlaSwitch-v0", {}, ConfigError, "Discrete"),
        ("no_such_module/Env-v0", {}, MissingDependency, "no_such_module"),
        ("VlaArm-v0", {"kwargs": {"colour": 1}}, ConfigError, "colour"),
        ("VlaArm-v0", {"state": {"joints": "robot/joints"}}, ConfigError, "qpos"),
        ("VlaArm-v0", {"state": {"joints": "robot/qpos[7:9]"}}, ConfigError, "4 numbers"),
        ("VlaArm-v0", {"state": {"joints": "robot/qpos[0:9]"}}, ConfigError, "4 numbers"),
        ("VlaArm-v0", {"state": {"joints": "robot/qpos[3:3]"}}, ConfigError, "empty"),
        ("VlaArm-v0", {"cameras": {"front": "images/top[0:3]"}}, ConfigError, "no range"),
        ("VlaArm-v0", {"success": "task/solved[0:1]"}, ConfigError, "no range"),
        ("FetchReach-v4", {"control_hz": 1.0}, ConfigError, "control_hz: expected 25"),
        ("gym_pusht/PushT-v0", {"control_hz": 50.0}, ConfigError, "control_hz: expected 10"),
        ("VlaArm-v0", {"state": {"joints": "robot[a]"}}, ConfigError, "range"),
        ("VlaArm-v0", {"cameras": {"front": "robot/qpos"}}, ConfigError, "uint8"),
        ("VlaArm-v0", {"gripper": "robot/qpos"}, ConfigError, "expected one number"),
        (
            "VlaArm-v0",
            {"gripper": "robot/qpos[3:]", "gripper_range": (1.0, 1.0)},
            ConfigError,
            "gripper_range",
        ),
    ],
)
def test_a_wrong_mapping_is_named_when_the_env_is_made(
    task: str | None, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        Gymnasium(task, **options)


def test_a_step_before_reset_a_chunk_a_negative_seed_and_a_closed_env_are_refused() -> None:
    env = make_env("gymnasium/VlaArm-v0")
    with pytest.raises(NotReset):
        env.step(Act(np.zeros(2, np.float32)))
    with pytest.raises(ConfigError, match="seed"):
        env.reset(seed=-1)
    env.reset(seed=0)
    with pytest.raises(InvalidAction, match="row by row"):
        env.step(Act(np.zeros((2, 2), np.float32)))
    env.close()
    with pytest.raises(NotReset):
        env.reset(seed=0)


def test_what_a_reset_leaves_behind_is_found_by_the_suite_and_cured_by_remake() -> None:
    # PushT draws the last action of the previous episode into the first rendered image
    options = {
        "kwargs": {"obs_type": "state"},
        "cameras": {"front": "render"},
        "width": 96,
        "height": 96,
    }
    with pytest.raises(ContractViolation, match="first observation"):
        check_env(make_env(PUSHT, **options), step_limit=False)
    check_env(make_env(PUSHT, **options, remake=True), step_limit=False)


def test_options_of_reset_reach_the_env_and_what_the_wire_cannot_carry_is_left_out() -> None:
    with make_env("gymnasium/VlaArm-v0") as env:
        _, info = env.reset(seed=0, options={"level": 2})
        assert info == {"options": {"level": 2}}


def test_plain_keeps_values_and_drops_objects() -> None:
    given = {
        "a": np.float32(1.5),
        2: (1, np.bool_(True)),
        "o": object(),
        "x": np.arange(2),
        "s": {"n": None, "t": "x"},
    }
    got = plain(given)
    assert got["a"] == 1.5
    assert type(got["a"]) is float
    assert got["2"] == [1, True]
    assert "o" not in got
    assert got["x"].tolist() == [0, 1]
    assert got["s"] == {"t": "x"}


def test_a_pick_of_a_scalar_is_a_vector_of_one() -> None:
    assert Pick.parse("a/b").vector({"a": {"b": 3}}).tolist() == [3.0]
    assert Pick.parse("").vector(np.arange(3)).tolist() == [0.0, 1.0, 2.0]
    with pytest.raises(ConfigError, match="shape"):
        Pick.parse("").vector(np.zeros((2, 2)))


def test_a_range_has_all_the_numbers_that_it_names() -> None:
    for size in range(1, 5):
        vector = np.arange(size, dtype=np.float32)
        ends = (None, *range(-6, 7))
        for start, stop in itertools.product(ends, ends):
            names = ["" if end is None else str(end) for end in (start, stop)]
            pick = Pick.parse(f"[{names[0]}:{names[1]}]")
            # The numbers of the range, as they would be of an endless vector on both sides.
            first, last = (
                default if end is None else end + size * (end < 0)
                for end, default in ((start, 0), (stop, size))
            )
            if 0 <= first < last <= size:
                assert pick.vector(vector).tolist() == list(range(first, last))
            else:
                with pytest.raises(ConfigError):
                    pick.vector(vector)


def test_images_are_stretched_and_there_is_no_more_info_than_the_envs() -> None:
    with Gymnasium("gym_pusht/PushT-v0", kwargs={"obs_type": "pixels_agent_pos"}) as large:
        whole = large.reset(seed=0)[0].cameras["front"]
    with Gymnasium(
        "gym_pusht/PushT-v0", kwargs={"obs_type": "pixels_agent_pos"}, width=32, height=32
    ) as env:
        obs, _ = env.reset(seed=0)
        np.testing.assert_array_equal(as_image(whole, "front", (32, 32)), obs.cameras["front"])
        assert obs.info == {}
