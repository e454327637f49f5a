"""A policy whose checkpoint is a number, and a library that counts the loads of each checkpoint."""

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
from vlagents_ray.serve.models.loaded_model import PolicySource


class Numbered(Agent):
    """A policy whose actions contain its checkpoint's number and the number of calls in the
    session.
    """

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
        self.library.threads.append(threading.current_thread().name)
        self.number = float(self.name.rpartition("/")[2])
        # A reference cycle, as in real policies: only garbage collection frees the policy.
        self.itself = self

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
    """Creates policies, and records loads, closed policies and batches."""

    def __init__(self) -> None:
        self.loads: Counter[str] = Counter()
        self.closed: list[str] = []
        self.threads: list[str] = []  # names of the threads that loaded policies
        self.alive: weakref.WeakValueDictionary[str, Agent] = weakref.WeakValueDictionary()
        self.batches: list[tuple[str, list[str]]] = []
        self.joints: dict[str, int] = {}  # number of joints in a checkpoint's contract
        self.held: dict[str, threading.Event] = {}  # events for which loading waits
        # Names of the checkpoints whose loading has begun.
        self.begun: queue.SimpleQueue[str] = queue.SimpleQueue()

    def make(self, settings: Mapping[str, Any]) -> Agent:
        return Numbered(self, settings)

    def hold(self, name: str) -> threading.Event:
        """Return an event; loading of `name` waits until it is set."""
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
        """Wait until loading of `name` has begun once more."""
        while self.begun.get(timeout=10) != name:
            pass

    def engine(self, **options: Any) -> Engine:
        """Return a running engine with the checkpoint "a/1"."""
        policy = PolicySource(self.make, {"checkpoint": "a/{step}", "checkpoint_step": 1})
        engine = Engine(policy, EngineSettings(**options))
        engine.start()
        return engine


def ask(engine: Engine, session: str, op: str, **fields: Any) -> queue.SimpleQueue[Reply]:
    """Send a request, and return the queue that will contain the reply."""
    return asked(engine, session, Request(op, Obs(**fields.pop("obs", {})), **fields))  # type: ignore[arg-type]


def begin(engine: Engine, session: str, **kwargs: Any) -> queue.SimpleQueue[Reply]:
    """Send a reset with these options."""
    return ask(engine, session, "reset", kwargs=kwargs)


def reset(engine: Engine, session: str, **kwargs: Any) -> str:
    """Reset a session, and return the checkpoint in the reply."""
    reply = begin(engine, session, **kwargs).get(timeout=10)
    if reply.error is not None:
        raise reply.error
    assert reply.info is not None
    return str(reply.info["checkpoint"])


def act(engine: Engine, session: str) -> list[float]:
    """Return the number of the session's checkpoint and of the call."""
    reply = ask(engine, session, "act").get(timeout=10)
    if reply.error is not None:
        raise reply.error
    assert reply.act is not None
    return list(reply.act.action.tolist())
