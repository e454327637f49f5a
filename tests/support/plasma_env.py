"""An environment in a Ray actor that sends observations over plasma.

Each actor is a process that imports this module, but no test module.
"""

from __future__ import annotations

import mmap
import os
import tempfile

import numpy as np
import ray

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.transports.select import TransportName


@ray.remote(num_cpus=0)
class EnvActor:
    """An environment in an actor, with one session of `app`."""

    def __init__(self, app: str, transport: TransportName = "plasma", size: int = 224) -> None:
        self.agent = RemoteAgent(f"serve://{app}", transport=transport)
        self.obs = Obs({name: np.full((size, size, 3), 7, np.uint8) for name in ("front", "wrist")})

    def open(self) -> int:
        """Reset, act once, and return this process's id."""
        self.agent.reset(self.obs, f"of {os.getpid()}")
        self.agent.act(self.obs)
        return os.getpid()

    def act(self, times: int) -> set[str]:
        """Act `times` times, and return the instructions in the policy's answers."""
        instructions = set()
        while times != 0:
            instructions.add(self.agent.act(self.obs).info["instruction"])
            times -= 1
        return instructions

    def storm(self) -> None:
        """Act until the process is killed."""
        self.act(-1)

    def channel(self) -> bytes:
        """Return Ray's id of the plasma channel."""
        key: bytes = self.agent._connection.transport._channel.binary()  # type: ignore[attr-defined]
        return key

    def die_writing(self) -> None:
        """Crash in the middle of writing a frame, because the pixels are in a mapped file that was
        truncated.
        """
        with tempfile.TemporaryFile() as file:
            file.truncate(mmap.PAGESIZE * 3)
            pixels = np.frombuffer(mmap.mmap(file.fileno(), 0), np.uint8).reshape(64, -1, 3)
            file.truncate(0)
            self.agent.act(Obs({"front": pixels}))
