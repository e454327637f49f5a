"""Each check of `check_env` fails for an environment with exactly this fault."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from vlagents_ray import Act, Obs
from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs import EvalEnv
from vlagents_ray.testing import ContractViolation, check_env
from vlagents_ray.validation import check_action

CONTRACT = Contract(
    cameras={"front": CameraSpec(4, 4)},
    state={"joints": StateSpec(2)},
    gripper=False,
    instruction=True,
    action=ActionSpec(dim=2, low=-1.0, high=1.0),
)


class GoodEnv(EvalEnv):
    """A moving point in a small image; the parent of all faulty environments."""

    max_steps = truncated_at = 6
    contract, instruction = CONTRACT, "go right"

    def __init__(self) -> None:
        self.position = np.zeros(2, np.float32)
        self.count = 0

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> Any:
        self.position = np.random.default_rng(seed).uniform(-1, 1, 2).astype(np.float32)
        self.count = 0
        return self.observe(), {}

    def step(self, act: Act) -> Any:
        action = check_action(act.action, self.contract)
        self.position = self.position + action
        self.count += 1
        success = bool(self.position[0] > 1)
        return (
            self.observe(),
            float(success),
            False,
            self.count >= self.truncated_at,
            {"success": success},
        )

    def observe(self) -> Obs:
        shade = int(abs(float(self.position[0])) * 40) % 256
        return Obs(
            cameras={"front": np.full((4, 4, 3), shade, np.uint8)},
            state={"joints": self.position.copy()},
        )

    def close(self) -> None:
        pass


class CarriesOver(GoodEnv):
    """An environment whose dynamics depend on the number of episodes."""

    episodes = 0

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> Any:
        self.episodes += 1
        return super().reset(seed=seed, options=options)

    def step(self, act: Act) -> Any:
        return super().step(replace(act, action=act.action * self.episodes))


class ChangingInstruction(GoodEnv):
    calls = 0

    @property
    def instruction(self) -> str:
        self.calls += 1
        return f"attempt {self.calls}"


class OneBuffer(GoodEnv):
    def __init__(self) -> None:
        super().__init__()
        self.image = np.zeros((4, 4, 3), np.uint8)

    def observe(self) -> Obs:
        self.image[:] = self.count
        return replace(super().observe(), cameras={"front": self.image})


class OneState(GoodEnv):
    def step(self, act: Act) -> Any:
        check_action(act.action, self.contract)
        self.position += act.action
        self.count += 1
        return self.observe(), 0.0, False, self.count >= self.max_steps, {"success": False}

    def observe(self) -> Obs:
        return replace(super().observe(), state={"joints": self.position})


def with_obs(change: Callable[[Obs], object]) -> type[GoodEnv]:
    class Changed(GoodEnv):
        def observe(self) -> Any:
            return change(super().observe())

    return Changed


def with_step(change: Callable[[list[Any]], object]) -> type[GoodEnv]:
    class Changed(GoodEnv):
        def step(self, act: Act) -> Any:
            result = list(super().step(act))
            changed = change(result)
            return tuple(result) if changed is None else changed

    return Changed


def variant(**attributes: Any) -> type[GoodEnv]:
    return type("Changed", (GoodEnv,), attributes)


def with_contract(**fields: Any) -> type[GoodEnv]:
    return variant(contract=replace(CONTRACT, **fields))


def with_reset(result: Callable[[Obs], object]) -> type[GoodEnv]:
    return variant(reset=lambda self, **options: result(GoodEnv.reset(self, **options)[0]))


NEVER_TRUNCATES = variant(truncated_at=99)


class FailsOtherwise(GoodEnv):
    def step(self, act: Act) -> Any:
        if act.action.shape != (2,):
            raise ValueError("shapes do not match")
        return super().step(act)


class ChangesAction(GoodEnv):
    def step(self, act: Act) -> Any:
        check_action(act.action, self.contract)
        act.action *= 0.5
        return super().step(act)


class ClosesOnce(GoodEnv):
    closed = False

    def close(self) -> None:
        if self.closed:
            raise RuntimeError("already closed")
        self.closed = True


BROKEN_ENVS: list[tuple[type[GoodEnv], str]] = [
    (
        variant(reset=lambda self, **_: GoodEnv.reset(self, seed=random.getrandbits(32))),
        "first observation.*pure function",
    ),
    (CarriesOver, "observation after step 1.*pure function"),
    (ChangingInstruction, "instruction is 'attempt"),
    (OneBuffer, r"cameras.*front.*a later step or reset changed it"),
    (OneState, r"state.*joints.*a later step or reset changed it"),
    (variant(contract={"action": 2}), "contract: expected a Contract, got dict"),
    (
        with_contract(action=ActionSpec()),
        "action.dim: expected the number of components of an action, got None",
    ),
    (with_contract(cameras={"front": CameraSpec(8, 8)}), "expected 8x8"),
    (with_contract(cameras={"wrist": CameraSpec()}), "camera 'wrist' is missing"),
    (with_contract(cameras={}), r"expected the cameras of the contract, \[\], got \['front'\]"),
    (with_contract(state={"joints": StateSpec(3)}), r"expected shape \(3,\)"),
    (
        with_contract(gripper=True),
        r"gripper: expected a number in \[0, 1\] where 1 = open, got None",
    ),
    (
        with_obs(lambda obs: replace(obs, gripper=0.5)),
        "expected no gripper, as in the contract, got 0.5",
    ),
    (
        with_obs(
            lambda obs: replace(obs, state={"joints": obs.state["joints"].astype(np.float64)})
        ),
        "float64",
    ),
    (with_obs(lambda obs: replace(obs, state={"joints": obs.state["joints"] * np.nan})), "NaN"),
    (with_obs(lambda obs: replace(obs, cameras={"front": obs.cameras["front"] / 255})), "float64"),
    (with_obs(lambda obs: replace(obs, info={"sim": object()})), r"Obs.info\['sim'\]"),
    (with_obs(lambda obs: {"front": obs.cameras["front"]}), "expected an Obs"),
    (with_step(lambda result: tuple(result[:4])), "got a tuple of 4"),
    (
        with_step(lambda result: result.__setitem__(1, np.float32(0))),
        "expected reward to be a float, got float32",
    ),
    (
        with_step(lambda result: result.__setitem__(2, np.bool_(False))),
        "expected terminated to be a bool, got bool",
    ),
    (
        with_step(lambda result: result.__setitem__(3, 0)),
        "expected truncated to be a bool, got int",
    ),
    (
        with_step(lambda result: result.__setitem__(4, {})),
        "expected info.'success'. to be a bool, got NoneType",
    ),
    (
        with_step(lambda result: result.__setitem__(4, {"success": np.bool_(False)})),
        "expected info.'success'. to be a bool, got bool",
    ),
    (
        with_step(lambda result: result.__setitem__(4, None)),
        "expected the info as a dict, got NoneType",
    ),
    (with_step(lambda result: result[4].update(score=np.float64(1))), r"info\['score'\]"),
    (variant(max_steps=0), "max_steps: expected an int of at least 1, got 0"),
    (NEVER_TRUNCATES, "is not truncated, but max_steps is 6"),
    (variant(truncated_at=5), "step 5 is truncated"),
    (
        variant(
            step=lambda self, act: GoodEnv.step(self, Act(np.nan_to_num(np.resize(act.action, 2))))
        ),
        r"for an action of shape \(3,\), got none: it was executed",
    ),
    (FailsOtherwise, "expected InvalidAction .*, got ValueError"),
    (ChangesAction, "leave the caller's array"),
    (ClosesOnce, "the second call raised"),
    (with_reset(lambda obs: (obs, {"scene": object()})), r"info\['scene'\]"),
    (with_reset(lambda obs: obs), r"reset: expected \(Obs, info\), got Obs"),
    (variant(instruction=""), "instruction: expected one, as the contract declares it"),
    (variant(describe=lambda _: {"mode": {1, 2}}), "describe"),
]


def test_a_good_env_passes_and_is_closed() -> None:
    env = ClosesOnce()
    with pytest.raises(ContractViolation, match="second"):
        check_env(env)
    assert env.closed
    check_env(GoodEnv())


@pytest.mark.parametrize(
    ("cls", "message"), BROKEN_ENVS, ids=lambda value: getattr(value, "__name__", str(value))
)
def test_a_broken_env_is_told_what_is_wrong(cls: type[GoodEnv], message: str) -> None:
    with pytest.raises(ContractViolation, match=f"(?s){message}"):
        check_env(cls())


def test_an_object_that_is_no_env_of_ours_is_refused() -> None:
    with pytest.raises(
        ContractViolation,
        match=(
            r"expected an EvalEnv, got .*; wrap an environment of Gymnasium with "
            r"make_env\('gymnasium/ID'\)"
        ),
    ):
        check_env(object())  # type: ignore[arg-type]


def test_an_env_whose_steps_are_not_reproducible_passes_if_told_so() -> None:
    check_env(CarriesOver(), same_steps=False)


def test_the_step_limit_is_left_alone_if_told_so() -> None:
    check_env(NEVER_TRUNCATES(), step_limit=False)
