"""Several clients of ours in a process, which act as fast as they are answered: `… -m vlagents_ray.bench.load`.

All clients of a benchmark live in a few such processes, or Ray actors, and begin at the same moment of
the machine's monotonic clock.
"""

from __future__ import annotations

import json
import random
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from vlagents_ray.bench.client import connect
from vlagents_ray.bench.observing import observation
from vlagents_ray.bench.peers.peer import die_with_parent, own_stdout
from vlagents_ray.client.agent import RemoteAgent

Call = tuple[float, float, float, int]  # ended, s of time.monotonic; round trip, ms; inference, ms; size of its batch
ROBOT, SIMULATION = "robot", "simulation"
_THINK_S = 0.05  # a robot asks at most so long after its last answer: it finds batches at any stage


class Load:
    """Clients of one process, one thread each."""

    def __init__(self, url: str, transport: str, codec: str, ranks: Sequence[str]) -> None:
        self._obs = observation()
        self._ranks = list(ranks)
        self._agents = [connect(url, transport, codec, rank) for rank in ranks]
        self._pool = ThreadPoolExecutor(max(1, len(ranks)))
        for ready in [self._pool.submit(agent.reset, self._obs, "measure") for agent in self._agents]:
            ready.result()

    def ready(self) -> bool:
        """For an actor: an answer says that `__init__` is done."""
        return True

    def run(self, active: int, begin: float, end: float) -> list[list[Call]]:
        """The first `active` clients act until `end`, s of `time.monotonic`.

        Returns for each client its calls that ended after `begin`.
        """
        acting = list(zip(self._agents, self._ranks, strict=True))[:active]
        return [one.result() for one in [self._pool.submit(self._act, *each, begin, end) for each in acting]]

    def close(self) -> None:
        """End all sessions."""
        for agent in self._agents:
            agent.close()
        self._pool.shutdown()

    def _act(self, agent: RemoteAgent, rank: str, begin: float, end: float) -> list[Call]:
        calls = []
        think = random.Random(0)
        while time.monotonic() < end:
            if rank == ROBOT:
                time.sleep(think.uniform(0, _THINK_S))
            timing = agent.act(self._obs).info["timing"]
            ended = time.monotonic()
            if begin <= ended < end:
                calls.append((ended, timing["round_trip_ms"], timing["inference_ms"], int(timing["batch_size"])))
        return calls


def main() -> None:
    """The process: its settings as JSON; then a line of JSON for each `run`, answered by one."""
    die_with_parent()
    out = own_stdout()
    load = Load(**json.loads(sys.argv[1]))
    print(json.dumps(load.ready()), file=out, flush=True)
    for line in sys.stdin:
        print(json.dumps(load.run(**json.loads(line))), file=out, flush=True)
    load.close()


if __name__ == "__main__":
    main()
