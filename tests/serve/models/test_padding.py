"""Batches with fixed sizes for compiled models."""

from __future__ import annotations

import copy
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar

import numpy as np
import pytest
from in_flight import answered, submit
from pydantic import ValidationError

from vlagents_ray.errors import PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.loading import current_report
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.config.deployment import BatchArgs
from vlagents_ray.serve.engine.engine import Engine

SIZES = [2, 4, 8]
SIZED: dict[str, Any] = {"max_batch_size": 8, "batch_sizes": SIZES}


class Compiled(Agent):
    """A policy that runs only batches of `SIZES`. Its actions contain the observed value and the
    step.
    """

    broken = False  # the last row of each batch fails

    def __init__(self) -> None:
        self.batches: list[list[str | None]] = []
        self.resets = 0

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.name, self.step, self.env = instruction, 0, kwargs["env"]
        return {}

    def act(self, obs: Obs) -> Act:
        self.step += 1
        return Act(np.array([float(obs.info["value"]), self.step]), info={"name": self.name})

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        self.batches.append([session.name for session in sessions])  # type: ignore[attr-defined]
        self.seen = [one.info["value"] for one in obs]
        if len(set(map(id, sessions))) != len(sessions) or len(obs) not in SIZES:
            raise RuntimeError(f"{len(obs)} rows")
        results: list[Act | Exception] = [s.act(o) for s, o in zip(sessions, obs, strict=True)]
        if Compiled.broken:
            results[-1] = RuntimeError("padding")
        return results


class Picky(Compiled):
    """A policy that can be reset only once in total."""

    made: ClassVar[list[int]] = []

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        Picky.made.append(1)
        if len(Picky.made) > 1:
            raise RuntimeError("only once")
        return super().reset(obs, instruction, **kwargs)

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        return [session.act(one) for one, session in zip(obs, sessions, strict=True)]


class Pads(Compiled):
    """A policy that pads its own batches."""

    def initialize(self) -> None:
        with current_report() as report:
            report.pads = True

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        assert len(obs) == 1
        return super().act_batch([*obs, *obs], [*sessions, copy.copy(sessions[0])])[:1]


def ask(engine: Engine, session: str, op: Any, value: int = 0, **fields: Any) -> Reply:
    if op == "reset":
        fields |= {"instruction": session, "kwargs": {"env": "lab"}}
    return answered(engine, session, Request(op, Obs(info={"value": value}), **fields))


@pytest.fixture(autouse=True)
def _whole() -> Iterator[None]:
    yield
    Compiled.broken = False


def test_a_batch_is_padded_up_to_the_next_size(serving: Callable[..., Engine]) -> None:
    agent = Compiled()
    engine = serving(agent, **SIZED)
    names = [f"s{i}" for i in range(11)]  # ten of them act, in batches of 8 and 2
    for name in names:
        ask(engine, name, "reset")
    replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
    busy, released = threading.Event(), threading.Event()
    submit(engine, "s0", Request("close"), lambda _: busy.set() or (released.wait(10) and None))
    assert busy.wait(10)  # the policy's thread is busy while all requests arrive
    for name in names[1:]:
        submit(engine, name, Request("act", Obs(info={"value": int(name[1:])})), replies.put)
    released.set()
    answers = [replies.get(timeout=10) for _ in names[1:]]
    assert [len(batch) for batch in agent.batches] == [8, 2]
    assert [reply.act.info["name"] for reply in answers if reply.act] == names[1:]
    assert [reply.act.action.tolist() for reply in answers if reply.act] == [
        [i, 1] for i in range(1, 11)
    ]
    assert [reply.timing["batch_size"] for reply in answers] == [8] * 8 + [2] * 2


def test_padding_acts_as_a_session_of_its_own_on_what_a_neighbour_sees(
    serving: Callable[..., Engine],
) -> None:
    agent = Compiled()
    engine = serving(agent, **SIZED)
    ask(engine, "first", "reset")
    ask(engine, "second", "reset")
    for step in range(1, 4):
        reply = ask(engine, "second", "act", value=7)
        assert (reply.act.action.tolist(), reply.act.info["name"]) == ([7, step], "second")
        assert reply.timing["batch_size"] == 1
        # The padding row began with the first session's reset.
        assert agent.batches[-1] == ["second", "first"]
        assert agent.seen == [7, 7]
    assert len(engine.sessions) == 2
    reply = ask(engine, "first", "act")
    assert reply.act.action[1] == 1  # the first session itself has not acted before


def test_nobody_hears_of_paddings_failure(serving: Callable[..., Engine]) -> None:
    engine = serving(Compiled(), **SIZED)
    ask(engine, "a", "reset")
    Compiled.broken = True
    for step in range(1, 4):
        reply = ask(engine, "a", "act")
        assert reply.act.action[1] == step


def test_without_padding_the_batch_runs_as_it_is(serving: Callable[..., Engine]) -> None:
    Picky.made.clear()
    engine = serving(Picky(), **SIZED)
    ask(engine, "a", "reset")
    for _ in range(3):
        assert ask(engine, "a", "act").error is None
    assert len(Picky.made) == 2  # padding is tried once


def test_a_policy_that_pads_gets_the_batch_as_it_is(serving: Callable[..., Engine]) -> None:
    engine = serving(Pads(), **SIZED)
    ask(engine, "a", "reset")
    assert ask(engine, "a", "act", 3).act.action.tolist() == [3, 1]


def test_a_refused_first_reset_is_not_what_padding_begins_with(
    serving: Callable[..., Engine],
) -> None:
    engine = serving(Compiled(), **SIZED)
    # This reset lacks the `env` that the policy needs.
    refused = answered(engine, "bad", Request("reset", Obs(), "bad"))
    assert isinstance(refused.error, PolicyFailed)
    ask(engine, "good", "reset")
    assert ask(engine, "good", "act").error is None


@pytest.mark.parametrize(
    ("args", "max_size"),
    [({}, 16), ({"max_size": 3}, 3), ({"sizes": [1, 4]}, 4), ({"sizes": [1, 4], "max_size": 4}, 4)],
)
def test_the_largest_size_is_the_batch_limit(args: dict[str, Any], max_size: int) -> None:
    checked = BatchArgs(**args)
    assert checked.max_size == max_size
    assert BatchArgs(**checked.model_dump()) == checked


@pytest.mark.parametrize(
    "args",
    [
        {"sizes": []},
        {"sizes": [0, 1]},
        {"sizes": [2, 1]},
        {"sizes": [1, 1]},
        {"sizes": [1, 8], "max_size": 16},
    ],
)
def test_sizes_that_contradict_are_refused(args: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="sizes"):
        BatchArgs(**args)
