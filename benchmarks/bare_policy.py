"""Runs a policy without a server, as a process of `throughput`: `python -m benchmarks.bare_policy
JSON`.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

from benchmarks.own_clients import observation
from vlagents_ray.registry import policy_class
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout


class BarePolicy:
    """A policy without a server, with batches of `batch` observations, as the reference for a
    served policy.
    """

    def __init__(self, policy: str, config: dict[str, Any], batch: int) -> None:
        self._agent = policy_class(policy).from_config(config)
        self._agent.initialize()
        self._obs = [observation()] * batch
        self._agent.reset(self._obs[0], "measure")
        self._batch()

    def rate(self, seconds: float) -> float:
        """Measure for at least `seconds`, and return the actions per second."""
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
    """Run a bare policy as a process: the settings are JSON, and each line with a time in s is
    answered with the rate.
    """
    die_with_parent()
    out = own_stdout()
    bare = BarePolicy(**json.loads(sys.argv[1]))
    print(json.dumps(True), file=out, flush=True)
    for line in sys.stdin:
        print(json.dumps(bare.rate(float(line))), file=out, flush=True)


if __name__ == "__main__":
    main()
