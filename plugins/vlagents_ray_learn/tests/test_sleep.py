"""A policy that rests while its learner needs the GPU: acts wait, memory is freed, and acts go
on.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np
import pytest
from gain_policies import Gain, gains, in_child
from in_flight import answered, submit

from vlagents_ray.errors import (
    DeadlineExceeded,
    InvalidInput,
    NotTrainable,
    Overloaded,
    PolicyUnavailable,
    UnchangedWeights,
)
from vlagents_ray.interface import Act, Agent, Obs, TrainableAgent
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.weights import trainable
from vlagents_ray.weights.trainable import portable
from vlagents_ray_learn import Publisher


@pytest.fixture
def serving() -> Iterator[Callable[..., Engine]]:
    engines: list[Engine] = []

    def serve(
        agent: Agent, *, clock: Callable[[], float] = time.perf_counter, **settings: Any
    ) -> Engine:
        engines.append(Engine(agent, EngineSettings(**settings), clock=clock))
        engines[-1].start()
        assert (
            answered(
                engines[-1], "s", Request("reset", Obs(), priority="simulation", kwargs={"seed": 3})
            ).error
            is None
        )
        return engines[-1]

    yield serve
    for engine in engines:
        engine.close()


class Noting(Gain):
    """Notes its acts and rests in a list of all sessions."""

    notes: ClassVar[list[str]]

    def initialize(self) -> None:
        super().initialize()
        Noting.notes = []

    def act(self, obs: Obs) -> Act:
        self.notes.append("act")
        return super().act(obs)

    def sleep(self) -> None:
        self.notes.append("sleep")

    def wake(self) -> None:
        self.notes.append("wake")


def asked(engine: Engine, **fields: Any) -> queue.SimpleQueue[Reply]:
    replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
    submit(engine, "s", Request("act", Obs(), **fields), replies.put)
    return replies


def acted(engine: Engine) -> tuple[int, list[float]]:
    reply = asked(engine).get(timeout=30)
    assert reply.act is not None, reply.error
    return reply.act.info["policy"]["version"], reply.act.action.tolist()


@pytest.mark.parametrize("offload", [True, False])
def test_acts_wait_until_the_policy_wakes(serving: Callable[..., Engine], offload: bool) -> None:
    agent = Noting()
    engine = serving(agent)
    with Publisher(engine) as weights:
        weights.sleep(offload=offload)
        first = asked(engine)
        agent.notes.append("updated")
        weights.wake()
        assert first.get(timeout=30).act is not None
        rest = ["sleep", "updated", "wake"] if offload else ["updated"]
        assert agent.notes == [*rest, "act"]
        weights.wake()  # of a policy that is awake: nothing
        weights.sleep(offload=offload)
        weights.wake()


@pytest.mark.parametrize("agent", [Gain, in_child], ids=["here", "in a child process"])
def test_the_first_act_is_made_with_the_weights_that_woke_the_policy(
    serving: Callable[..., Engine], agent: type[Gain]
) -> None:
    engine, alone = serving(agent()), serving(Gain())
    with Publisher(engine) as weights:
        assert acted(engine) == acted(alone)
        weights.sleep()
        first = asked(engine)
        with pytest.raises(Overloaded, match="already asleep; call wake first"):
            weights.sleep()
        with pytest.raises(
            PolicyUnavailable, match="got one that sleeps; pass the new values to wake"
        ):
            weights.push(gains(1))
        assert weights.wake(gains(2)) == 1
        reply = first.get(timeout=30)
        assert reply.act is not None
        assert (reply.act.info["policy"]["version"], reply.act.action[0]) == (1, 2.0)
        assert reply.act.action[-1] == acted(alone)[1][-1], "the session goes on"
        weights.sleep()
        with pytest.raises(UnchangedWeights):
            weights.wake(gains(2))
        assert acted(engine)[0] == 1, "it wakes nevertheless"


def test_an_act_whose_deadline_passes_is_not_made(serving: Callable[..., Engine]) -> None:
    agent, now = Noting(), [time.perf_counter()]
    engine = serving(agent, clock=lambda: now[0])
    weights = Publisher(engine)
    weights.sleep(offload=False)
    late = asked(engine, deadline_ms=1e3)
    now[0] += 1000
    weights.wake()
    assert isinstance(late.get(timeout=30).error, DeadlineExceeded)
    assert agent.notes == []


def test_a_policy_whose_learner_died_wakes_by_itself(
    serving: Callable[..., Engine], caplog: pytest.LogCaptureFixture
) -> None:
    engine = serving(Noting())
    Publisher(engine).sleep(at_most_s=0.01)
    assert acted(engine)[0] == 0
    assert "wakes without its learner" in caplog.text
    with pytest.raises(InvalidInput, match=r"at_most_s: expected seconds in .*, got 0"):
        Publisher(engine).sleep(at_most_s=0)


def test_no_alarm_is_left_of_a_sleep_that_its_learner_ended(
    serving: Callable[..., Engine], caplog: pytest.LogCaptureFixture
) -> None:
    engine = serving(Noting())
    weights = Publisher(engine)
    for _ in range(2):
        weights.sleep(at_most_s=0.3)
        weights.wake()
    time.sleep(0.5)
    assert acted(engine)[0] == 0
    assert "wakes without its learner" not in caplog.text


def test_a_replica_that_ends_does_not_wait_for_the_learner(serving: Callable[..., Engine]) -> None:
    engine = serving(Gain())
    Publisher(engine).sleep()
    waiting = asked(engine)
    engine.close()
    assert not engine.health.alive
    reply = waiting.get(timeout=30)
    assert reply.act is not None or isinstance(reply.error, PolicyUnavailable)


def test_a_policy_without_parameters_rests_but_moves_nothing(
    serving: Callable[..., Engine],
) -> None:
    class Fixed(Agent):
        def act(self, obs: Obs) -> Act:
            return Act(np.zeros(1))

    engine = serving(Fixed())
    with pytest.raises(NotTrainable):
        Publisher(engine).sleep()
    Publisher(engine).sleep(offload=False)
    Publisher(engine).wake()
    assert acted(engine)[0] == 0


@pytest.mark.torch
def test_all_memory_on_the_gpu_moves_to_the_host_and_back(
    serving: Callable[..., Engine], monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    class OnGpu(TrainableAgent):
        """A layer whose CPU takes the place of a GPU, with tied weights and views of one memory."""

        trainable: ClassVar[str | None] = "layer"

        def initialize(self) -> None:
            torch.manual_seed(0)
            self.layer = torch.nn.Linear(4, 4).requires_grad_(False)
            self.layer.tied = self.layer.weight
            self.layer.part = torch.nn.Parameter(self.layer.weight[1:3].T, requires_grad=False)

        def act(self, obs: Obs) -> Act:
            return Act(self.layer(torch.ones(1, 4))[0].numpy().copy())

    monkeypatch.setattr(trainable, "_on_gpu", lambda _: True)
    # As from a GPU.
    monkeypatch.setattr(trainable, "portable", lambda value: portable(value.clone()))
    agent = OnGpu()
    engine = serving(agent)
    weights = Publisher(engine)
    weights.push({"bias": torch.full((4,), 7.0)}, partial=True)  # held beside the version that acts
    own, before = engine.model.own_weights, acted(engine)
    memories = [
        one.untyped_storage() for one in (*agent.parameters().values(), *own.newest.values.values())
    ]
    assert all(memory.nbytes() for memory in memories)
    hosts, made = torch.UntypedStorage, list[int]()

    def short_of_memory(size: int) -> Any:
        made.append(size)
        if len(made) == 2:
            raise RuntimeError("DefaultCPUAllocator: can't allocate memory")
        return hosts(size)

    with monkeypatch.context() as patch:
        patch.setattr(torch, "UntypedStorage", short_of_memory)
        with pytest.raises(RuntimeError, match="can't allocate"):
            weights.sleep()
    assert acted(engine) == before, "what had moved came back"
    weights.sleep()
    assert not any(memory.nbytes() for memory in memories)

    calls: list[int] = []

    def full(moved: list[Any]) -> None:
        calls.append(len(moved))
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    with monkeypatch.context() as patch:
        patch.setattr(trainable, "from_host", full)
        with pytest.raises(
            PolicyUnavailable, match="too little memory for the policy, which still sleeps"
        ):
            weights.wake()
    assert calls == [5], "weight and bias, and the weight, bias and part that version 1 keeps"
    weights.wake()
    assert all(memory.nbytes() for memory in memories)
    assert acted(engine) == before
    assert agent.layer.part.data_ptr() == agent.layer.weight[1:3].data_ptr()
