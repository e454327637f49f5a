"""A client of the shared-memory endpoint, and a policy that keeps its observations."""

from __future__ import annotations

import os
import threading
from typing import Any

import numpy as np

from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import MessageLimits, Reply, Request
from vlagents_ray.serve.endpoints.shm import ShmServer

LIMITS = MessageLimits(body_bytes=4 * 2**20)


class Keeper(Agent):
    """A policy that keeps its observations, like a policy with history."""

    gate: threading.Event | None = None

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction, self.seen = instruction, []
        return {}

    def act(self, obs: Obs) -> Act:
        if obs.info.get("wait") and Keeper.gate is not None:
            Keeper.gate.wait(10)
        self.seen.append(obs.cameras["front"])
        action = [float(image[0, 0, 0]) for image in self.seen[-4:]]
        if not obs.info:
            return Act(np.array(action))
        return Act(
            np.array(action),
            info={"instruction": self.instruction, "big": bytes(obs.info.get("reply", 0))},
        )


def request(op: Any, pixel: int = 0, size: int = 64, **info: Any) -> Request:
    obs = Obs({"front": np.full((size, size, 3), pixel, np.uint8)}, info=info)
    return Request(
        op,
        obs,
        instruction=f"task {pixel}" if op == "reset" else None,
        request_id=os.urandom(8).hex(),
    )


def call(transport: ShmTransport, one: Request, timeout_s: float) -> Reply:
    [reply] = transport.call([one], timeout_s)
    return reply


def client(server: ShmServer) -> ShmTransport:
    transport = ShmTransport(server.address)
    transport.connect(5)
    return transport
