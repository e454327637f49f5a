"""Each check of `check_agent` fails for a policy with exactly this fault, and names the place where
two values differ.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.testing import ContractViolation, check_agent, difference, require_wireable

CONTRACT = Contract(state={"joints": StateSpec(2)}, action=ActionSpec(dim=2))


class GoodAgent(Agent):
    """A policy with state and seeds that uses its observation and instruction; the parent of all
    faulty ones.
    """

    contract = CONTRACT

    def __init__(self) -> None:
        self.weights = np.zeros(0, np.float32)
        self.told = ""
        self.count = 0
        self.rng = np.random.default_rng(0)

    def initialize(self) -> None:
        self.weights = np.full(2, 0.5, np.float32)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.told, self.count = instruction or "", 0
        self.rng = np.random.default_rng(kwargs.get("seed", 0))
        return {}

    def act(self, obs: Obs) -> Any:
        self.count += 1
        noise = self.rng.normal(0, 0.1, 2)
        action = obs.state["joints"] * self.weights + self.count + len(self.told) + noise
        return Act(action.astype(np.float32))


class CannotCopy(GoodAgent):
    def initialize(self) -> None:
        super().initialize()
        self.lock = threading.Lock()


class SharesItsLock(CannotCopy):
    shared = ("lock", "weights")


class Box:
    count = 0


class SharesItsCount(GoodAgent):
    shared = ("box",)

    def __init__(self) -> None:
        super().__init__()
        self.box = Box()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.box.count = 0
        return super().reset(obs, instruction, **kwargs)

    def act(self, obs: Obs) -> Any:
        self.box.count += 1
        return Act(np.full(2, self.box.count, np.float32))


def with_reset(change: Callable[[GoodAgent, Obs], object]) -> type[GoodAgent]:
    """Return a policy whose reset ends with this change, and returns its result."""

    class Changed(GoodAgent):
        def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> Any:
            super().reset(obs, instruction, **kwargs)
            return change(self, obs)

    return Changed


def with_act(change: Callable[[Act, Obs], object]) -> type[GoodAgent]:
    class Changed(GoodAgent):
        def act(self, obs: Obs) -> Any:
            return change(super().act(obs), obs)

    return Changed


def with_batch(change: Callable[[list[Act | Exception], Sequence[Obs]], object]) -> type[GoodAgent]:
    class Changed(GoodAgent):
        def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> Any:
            return change(super().act_batch(obs, sessions), obs)

    return Changed


def with_contract(contract: object) -> type[GoodAgent]:
    return type("Changed", (GoodAgent,), {"contract": contract})


class OneActionBuffer(GoodAgent):
    def initialize(self) -> None:
        super().initialize()
        self.buffer = np.zeros(2, np.float32)

    def act(self, obs: Obs) -> Any:
        self.buffer[:] = super().act(obs).action
        return Act(self.buffer)


class ActsByItself(GoodAgent):
    """A policy that ignores the sessions and calls the shared agent."""

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        return [self.act(one) for one in obs]


class PreparesOtherwise(GoodAgent):
    def prepare(self, obs: Obs) -> Any:
        return obs.state["joints"] * np.float32(0.999)

    def act(self, obs: Obs) -> Any:
        return super().act(
            obs if obs.prepared is None else replace(obs, state={"joints": obs.prepared})
        )


class Prepares(GoodAgent):
    """A policy that uses the result of `prepare` in `act`."""

    def prepare(self, obs: Obs) -> Any:
        return {"joints": obs.state["joints"] * 1, "text": self.told}

    def act(self, obs: Obs) -> Any:
        return super().act(obs if obs.prepared is None else replace(obs, state=obs.prepared))


class Tokenizer:
    """A tokenizer that keeps its padding as state, like fast tokenizers. Padded texts have five
    letters.
    """

    padded = False

    def __call__(self, text: str, *, padded: bool) -> list[str]:
        self.padded = padded
        time.sleep(1e-4)  # another thread may call the tokenizer
        return [*text, *(" " * (5 - len(text)) if self.padded else "")]


class SharesItsTokenizer(Prepares):
    shared = ("tokenizer", "weights")

    def initialize(self) -> None:
        super().initialize()
        self.tokenizer = Tokenizer()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.tokenizer("ab", padded=False)
        return super().reset(obs, instruction, **kwargs)

    def prepare(self, obs: Obs) -> Any:
        return {**super().prepare(obs), "tokens": self.tokenizer("ab", padded=True)}


class CountsTokensWithIt(SharesItsTokenizer):
    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        if len(self.tokenizer("ab", padded=False)) > 2:
            raise ValueError("too many tokens")
        return super().reset(obs, instruction, **kwargs)

    def prepare(self, obs: Obs) -> Any:
        self.tokenizer("ab", padded=True)
        return Prepares.prepare(self, obs)


class PreparesOnOneThread(Prepares):
    def prepare(self, obs: Obs) -> Any:
        if threading.current_thread() is not threading.main_thread():
            raise RuntimeError("Already borrowed")
        return super().prepare(obs)


class LocksItsTokenizer(SharesItsTokenizer):
    shared = ("tokenizer", "weights", "lock")

    def initialize(self) -> None:
        super().initialize()
        self.lock = threading.Lock()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        with self.lock:
            return super().reset(obs, instruction, **kwargs)

    def prepare(self, obs: Obs) -> Any:
        with self.lock:
            return super().prepare(obs)


class ParsesItsInstruction(GoodAgent):
    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        {"go home": 0}[instruction or ""]
        return super().reset(obs, instruction, **kwargs)


class ParsesItInAct(ParsesItsInstruction):
    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return GoodAgent.reset(self, obs, instruction, **kwargs)

    def act(self, obs: Obs) -> Any:
        {"go home": 0}[self.told]
        return super().act(obs)


class SleepsForEver(GoodAgent):
    def sleep(self) -> None:
        """Free memory that is never allocated again."""


class AgentClosesOnce(GoodAgent):
    closed = False

    def close(self) -> None:
        if self.closed:
            raise RuntimeError("already closed")
        self.closed = True


class LocksInReset(GoodAgent):
    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.lock = threading.Lock()
        return super().reset(obs, instruction, **kwargs)


class ForgetsItsCount(GoodAgent):
    """A policy whose state leaves out what later actions depend on."""

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "count": 0}


class TakesNoSeed(GoodAgent):
    def reset(self, obs: Obs, instruction: str | None) -> dict[str, Any]:  # type: ignore[override]
        return super().reset(obs, instruction)


BROKEN_AGENTS: list[tuple[type[GoodAgent], str]] = [
    (CannotCopy, "cannot be copied.*`shared`"),
    (SharesItsCount, "depends on other sessions"),
    (
        with_reset(lambda agent, _: setattr(agent, "rng", np.random.default_rng()) or {}),
        "must give the same actions",
    ),
    (with_act(lambda act, obs: obs.state["joints"].fill(9) or act), "act changed its argument"),
    (
        with_reset(lambda _, obs: obs.cameras.update(front=obs.cameras["front"][:2]) or {}),
        "reset changed its argument",
    ),
    (
        with_batch(lambda acts, obs: obs[0].info.update(seen=True) or acts),
        "act_batch changed its arguments",
    ),
    (OneActionBuffer, "an earlier act.*a later call changed it"),
    (with_batch(lambda acts, _: acts[::-1]), "session 0 in a batch of 2"),
    (with_batch(lambda acts, _: acts[:2]), "expected a list of 3 Acts, got 2 of them"),
    (with_batch(lambda _, obs: [RuntimeError("out of memory") for _ in obs]), "out of memory"),
    (ActsByItself, "act_batch must return the action"),
    (with_batch(lambda acts, _: tuple(acts)), "got tuple"),
    (with_act(lambda act, _: act.action), "act: expected an Act, got ndarray"),
    (with_act(lambda act, _: replace(act, action=act.action.astype(np.float64))), "float64"),
    (
        with_act(lambda act, _: replace(act, action=act.action.tolist())),
        "the action as a numpy array of float32, got list",
    ),
    (with_act(lambda act, _: replace(act, action=act.action * np.nan)), "NaN"),
    (with_act(lambda act, _: replace(act, action=act.action[:1])), "expected 2 numbers a row"),
    (
        with_act(lambda act, _: replace(act, done=np.bool_(True))),
        "expected done to be a bool, got bool",
    ),
    (with_act(lambda act, _: replace(act, info={"t": np.float32(1)})), r"info\['t'\]"),
    (
        PreparesOtherwise,
        "on a prepared observation.*`act` must compute the same with and without `prepare`",
    ),
    (SharesItsTokenizer, r"prepare of session . on a thread.*\['tokens'\].*a tokenizer's padding"),
    (
        CountsTokensWithIt,
        "reset: expected no error, got ValueError.*too many tokens.*on several threads",
    ),
    (
        PreparesOnOneThread,
        "prepare: expected no error, got RuntimeError.*Already borrowed.*on several threads",
    ),
    (
        ParsesItsInstruction,
        r"reset: expected no error, got KeyError.* for the instruction 'pick up the cube'.*instructions=\[",
    ),
    (
        ParsesItInAct,
        r"act: expected no error, got KeyError.* for the instruction 'pick up the cube' .*instructions=\[",
    ),
    (
        with_contract(replace(CONTRACT, chunk=4)),
        "expected 4 rows in the action, as in the contract, got 1",
    ),
    (with_contract({}), "contract: expected a Contract or None, got dict"),
    (with_reset(lambda *_: None), "reset: expected a dict, got NoneType"),
    (with_reset(lambda agent, _: {"agent": agent}), r"info\['agent'\]"),
    (LocksInReset, "session cannot be pickled in the middle of its episode.*lock"),
    (ForgetsItsCount, "act 1 of session 0 after a move.*must continue there"),
    (TakesNoSeed, r"TakesNoSeed.reset: expected the parameters \(obs, instruction, \*\*kwargs\)"),
    (SleepsForEver, r"expected all of \['sleep', 'wake'\].*got none named \['wake'\]"),
    (AgentClosesOnce, "the second call raised"),
]


@pytest.mark.slow
@pytest.mark.parametrize("cls", [GoodAgent, SharesItsLock, Prepares, LocksItsTokenizer])
def test_a_good_agent_passes(cls: type[GoodAgent]) -> None:
    check_agent(cls())


@pytest.mark.parametrize(
    ("cls", "message"), BROKEN_AGENTS, ids=lambda value: getattr(value, "__name__", str(value))
)
def test_a_broken_agent_is_told_what_is_wrong(cls: type[GoodAgent], message: str) -> None:
    with pytest.raises(ContractViolation, match=f"(?s){message}"):
        check_agent(cls())


def test_a_class_in_place_of_its_object_is_refused() -> None:
    with pytest.raises(ContractViolation, match="expected an object of a class that derives from"):
        check_agent(GoodAgent)  # type: ignore[arg-type]


def test_instructions_that_the_policy_knows_can_be_given() -> None:
    check_agent(ParsesItsInstruction(), instructions=["go home"])


def test_an_agent_without_contract_is_shown_some_observation() -> None:
    class Plain(Agent):
        def act(self, obs: Obs) -> Act:
            return Act(obs.state["joints"] + obs.cameras["front"].mean(dtype=np.float32))

    check_agent(Plain())


def test_a_difference_says_where_it_is() -> None:
    assert difference(Obs(gripper=0.5), Obs(gripper=0.5), "obs") is None
    assert "'gripper'" in str(difference(Obs(gripper=0.5), Obs(gripper=0.6), "obs"))
    assert "has ['a'] once" in str(difference({"a": 1}, {"b": 1}, "info"))
    assert "2 items once" in str(difference([1, 2], [1], "info"))
    assert "(2,) float32 once" in str(
        difference(np.zeros(2, np.float32), np.zeros(3, np.float32), "x")
    )
    assert difference(np.zeros(2), np.full(2, 1e-6), "x", atol=1e-5) is None


def test_what_the_wire_carries_is_accepted_and_nothing_else() -> None:
    require_wireable({"a": [None, True, 1, 1.5, "x", b"y", np.zeros(2, bool)], "b": {}}, "info")
    for value in (
        object(),
        (1, 2),
        {1: "a"},
        np.float32(1),
        np.array(["a"]),
        {"a": [object()]},
        {1},
    ):
        with pytest.raises(ContractViolation, match="info"):
            require_wireable(value, "info")
