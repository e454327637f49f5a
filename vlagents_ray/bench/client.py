"""A client of ours in a process of its own: `python -m vlagents_ray.bench.client JSON`, under the line protocol.

The peers' clients run like this, too; and one that runs inside another network namespace must.
"""

from __future__ import annotations

import inspect
import json
import sys
from typing import Any

from vlagents_ray.bench.observing import observation
from vlagents_ray.bench.peers.peer import WARM_UP, die_with_parent, obey, own_stdout, timed
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.wire.codecs import ImageCodec


def connect(url: str, transport: str, codec: str, rank: str | None = None) -> RemoteAgent:
    """An agent that has not connected yet.

    `codec` is "auto", "raw", "jpeg", or "jpeg QUALITY SUBSAMPLING". `rank` is "robot" or "simulation", and
    has no effect where `RemoteAgent` knows no ranks.
    """
    name, *details = codec.split()
    chosen = ImageCodec(name, int(details[0]), details[1]) if details else codec
    ranked = {"rank": rank} if rank and "rank" in inspect.signature(RemoteAgent).parameters else {}
    return RemoteAgent(url, transport=transport, codec=chosen, **ranked)  # type: ignore[arg-type]


class Caller:
    """One session that measures its own calls. A Ray actor holds it as well as a process does."""

    def __init__(self, url: str, transport: str, codec: str) -> None:
        self._agent = connect(url, transport, codec)
        self._obs = observation()
        info = self._agent.reset(self._obs, "measure")
        self.said: dict[str, Any] = {"transport": self._agent.transport, "psnr_db": info.get("psnr_db")}

    def measure(self, calls: int) -> list[float]:
        """Milliseconds of each."""
        return timed(lambda: self._obs, self._agent.act, calls)

    def ready(self) -> dict[str, Any]:
        """Warm up; returns what a driver says when it is ready."""
        self.measure(WARM_UP)
        return self.said

    def close(self) -> None:
        """End the session."""
        self._agent.close()


def main() -> None:
    """The process."""
    die_with_parent()
    out = own_stdout()
    caller = Caller(**json.loads(sys.argv[1]))
    try:
        obey(sys.stdin, out, caller.measure, caller.said)
    finally:
        caller.close()


if __name__ == "__main__":
    main()
