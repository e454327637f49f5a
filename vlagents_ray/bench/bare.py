"""A policy without any server, batch after batch: `python -m vlagents_ray.bench.bare JSON`.

What a served policy is compared with: the same `act_batch`, on the same observations, in full batches.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

from vlagents_ray.bench.observing import observation
from vlagents_ray.bench.peers.peer import die_with_parent, own_stdout
from vlagents_ray.registry import policy_class


class Bare:
    """The policy, `batch` observations at a time."""

    def __init__(self, policy: str, config: dict[str, Any], batch: int) -> None:
        self._agent = policy_class(policy).from_config(config)
        self._agent.initialize()
        self._obs = [observation()] * batch
        self._agent.reset(self._obs[0], "measure")
        self._batch()

    def rate(self, seconds: float) -> float:
        """Actions a second over at least that time, s."""
        begun = time.perf_counter()
        batches = 0
        while (taken := time.perf_counter() - begun) < seconds or batches == 0:
            self._batch()
            batches += 1
            taken = time.perf_counter() - begun
        return batches * len(self._obs) / taken

    def _batch(self) -> None:
        for act in self._agent.act_batch(self._obs, [self._agent] * len(self._obs)):
            if isinstance(act, Exception):
                raise act


def main() -> None:
    """The process: its settings as JSON; then a number of seconds a line, answered by the rate."""
    die_with_parent()
    out = own_stdout()
    bare = Bare(**json.loads(sys.argv[1]))
    print(json.dumps(True), file=out, flush=True)
    for line in sys.stdin:
        print(json.dumps(bare.rate(float(line))), file=out, flush=True)


if __name__ == "__main__":
    main()
