"""A replica without Ray or sockets that records its sessions, and a robot that connects to it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from in_flight import send

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.replica.part import PartContext
from vlagents_ray_live.recording import RecordConfig, Recording, SessionRecorder

HEIGHT, WIDTH = 33, 48


class Brightness(Agent):
    """A policy whose chunk depends on each pixel, the state, the step and the seed."""

    def __init__(self, gain: float = 1.0, chunk: int = 4) -> None:
        self.gain, self.rows = gain, chunk

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=2, space="joint"), chunk=self.rows)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._rng = np.random.default_rng(kwargs.get("seed") or 0)
        return {}

    def act(self, obs: Obs) -> Act:
        if obs.info.get("fail"):
            raise RuntimeError("as requested")
        seen = np.array([obs.cameras["front"].astype(np.float64).mean(), obs.state["joints"][0]])
        noise = self._rng.normal(size=(obs.info.get("rows", self.rows), 2))
        return Act(
            (self.gain * seen + noise + obs.info.get("offset", 0)).astype(np.float32),
            info={"subtask": "reach", "pid": os.getpid()},
        )


@dataclass(frozen=True)
class Recorded:
    engine: Engine
    recorder: SessionRecorder

    def robot(self) -> Robot:
        return Robot(Sender(self.engine, "shm", caller=NoKey.OPEN, has_left=None))


@dataclass(frozen=True)
class Robot:
    sender: Sender

    def ask(self, request: Request) -> Reply:
        replies: Future[list[Reply]] = Future()
        send(self.sender, [request], replies.set_result)
        [reply] = replies.result(10)
        return reply

    def play(
        self, acts: int, seed: int = 0, first: int = 0, instruction: str = "stack the cups"
    ) -> list[np.ndarray]:
        """Begin an episode, act `acts` times, and return the chunks."""
        reset = self.ask(Request("reset", seen(first), instruction, {"seed": seed}))
        assert reply_of(reset).error is None
        return [self.act(seen(first + i)) for i in range(acts)]

    def act(self, obs: Obs) -> np.ndarray:
        act = reply_of(self.ask(Request("act", obs))).act
        assert act is not None
        return act.rows()


def reply_of(reply: Reply) -> Reply:
    assert reply.error is None, reply.error
    return reply


def seen(i: int, side: int = WIDTH) -> Obs:
    """Return the observation at a robot's step `i`."""
    image = np.random.default_rng(i).integers(0, 256, (HEIGHT, side, 3), np.uint8)
    state = {"joints": np.array([i, -i], np.float32)}
    return Obs({"front": image}, 0.5, state, {"captured_at": 1e9 + i, "offset": i / 4})


@contextmanager
def recorded(
    folder: Path, agent: Agent | Engine | None = None, **settings: Any
) -> Iterator[Recorded]:
    """Run a replica that records with these settings of `parts: {record: ...}`."""
    engine = agent if isinstance(agent, Engine) else Engine(agent or Brightness())
    engine.start()

    def metadata() -> dict[str, Any]:
        assert engine.contract is not None
        return {
            "policy": "brightness",
            "contract": engine.contract.to_json(),
            "passes": engine.model.passes,
        }

    context = PartContext(engine, "SERVE_REPLICA::app#Policy#a1", "here", metadata)
    part = Recording(RecordConfig(folder=str(folder), **settings), context)
    part.open()
    engine.observers.add(part.observer())
    try:
        yield Recorded(engine, part.recorder)
    finally:
        engine.close()
        engine.observers.remove(part.recorder)
        part.recorder.close()
        part.close()
