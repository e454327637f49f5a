"""A policy whose checkpoint is a number, and a library that counts how often each checkpoint is
loaded.
"""

from __future__ import annotations

import queue
import threading
import weakref
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from in_flight import asked

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.contract import Contract, StateSpec
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.models.checkpoints import Checkpoints


class Numbered(Agent):
    """Acts by its number and how often its session has acted."""

    shared = ("library",)

    def __init__(self, library: Library, settings: Mapping[str, Any]) -> None:
        self.library = library
        self.name = settings["checkpoint"].replace("{step}", str(settings.get("checkpoint_step")))

    @property
    def contract(self) -> Contract | None:
        joints = self.library.joints.get(self.name)
        return None if joints is None else Contract(state={"joints": StateSpec(joints)})

    def initialize(self) -> None:
        self.library.load(self)
        self.number = float(self.name.rpartition("/")[2])
        self.itself = self  # as agents do; only a garbage collection frees it

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.steps = 0
        if kwargs.get("fail"):
            raise RuntimeError("as told")
        return {"options": kwargs}

    def act(self, obs: Obs) -> Act:
        self.steps += 1
        return Act(np.array([self.number, self.steps], np.float32))

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        self.library.batches.append((self.name, [session.name for session in sessions]))  # type: ignore[attr-defined]
        return super().act_batch(obs, sessions)

    def close(self) -> None:
        self.library.closed.append(self.name)


class Library:
    """Makes agents, and says what became of them."""

    def __init__(self) -> None:
        self.loads: Counter[str] = Counter()
        self.closed: list[str] = []
        self.alive: weakref.WeakValueDictionary[str, Agent] = weakref.WeakValueDictionary()
        self.batches: list[tuple[str, list[str]]] = []
        self.joints: dict[str, int] = {}  # that a checkpoint's contract asks for
        self.held: dict[str, threading.Event] = {}  # loading waits for it
        self.begun: queue.SimpleQueue[str] = queue.SimpleQueue()  # loads

    def make(self, settings: Mapping[str, Any]) -> Agent:
        return Numbered(self, settings)

    def hold(self, name: str) -> threading.Event:
        """Have the loading of `name` wait for the event."""
        return self.held.setdefault(name, threading.Event())

    def load(self, agent: Numbered) -> None:
        self.loads[agent.name] += 1
        self.begun.put(agent.name)
        if agent.name in self.held:
            assert self.held[agent.name].wait(30)
        if not agent.name.rpartition("/")[2].isdecimal():
            raise FileNotFoundError(f"no such checkpoint: {agent.name}")
        self.alive[agent.name] = agent

    def wait_for(self, name: str) -> None:
        """Until loading of `name` has begun once more."""
        while self.begun.get(timeout=10) != name:
            pass

    def engine(
        self, *, choices: Sequence[str] = (), steps: bool = False, loaded: int = 2, **options: Any
    ) -> Engine:
        """A running one whose own checkpoint is "a/1"; `choices` are such as "b/2", by their
        first letter.
        """
        config = {"checkpoint": "a/{step}", "checkpoint_step": 1}
        named = {choice[0]: {"checkpoint": choice} for choice in choices}
        checkpoints = Checkpoints(self.make, config, named, steps=steps, loaded=loaded)
        engine = Engine(checkpoints, EngineSettings(**options))
        engine.start()
        return engine


def ask(engine: Engine, session: str, op: str, **fields: Any) -> queue.SimpleQueue[Reply]:
    """Where the answer will come."""
    return asked(engine, session, Request(op, Obs(**fields.pop("obs", {})), **fields))  # type: ignore[arg-type]


def begin(engine: Engine, session: str, **kwargs: Any) -> queue.SimpleQueue[Reply]:
    """Reset with these options."""
    return ask(engine, session, "reset", kwargs=kwargs)


def reset(engine: Engine, session: str, **kwargs: Any) -> str:
    """The checkpoint that a session is told it got."""
    reply = begin(engine, session, **kwargs).get(timeout=10)
    if reply.error is not None:
        raise reply.error
    assert reply.info is not None
    return str(reply.info["checkpoint"])


def act(engine: Engine, session: str) -> list[float]:
    """The number of its checkpoint, and of the act."""
    reply = ask(engine, session, "act").get(timeout=10)
    if reply.error is not None:
        raise reply.error
    assert reply.act is not None
    return list(reply.act.action.tolist())
