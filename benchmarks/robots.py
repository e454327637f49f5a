"""Robots that act at their rate and do nothing else: `python -m benchmarks.robots URL`.

Each line that the process reads is a burst, {"robots": 12, "hz": 10, "seconds": 20}. At its end it writes each robot's
figures.
"""

from __future__ import annotations

import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from benchmarks.own_clients import observation
from vlagents_ray.bench.line_client import die_with_parent, own_stdout
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.errors import VLAgentsError

_CONNECT_S = 120.0


class RobotBurst(NamedTuple):
    """One robot's figures of a burst."""

    reset_s: float  # duration of the first reset, connection included
    acts: list[tuple[float, float]]  # time of the answer, s of `time.time()`, and duration, ms
    resumed: int  # acts before which the session had to begin again
    failed: list[str]  # reasons of acts without an action, or of a failed reset


def burst(url: str, robots: int, hz: float, seconds: float) -> list[RobotBurst]:
    """Run all robots at once, each for `seconds` after its reset."""
    with ThreadPoolExecutor(robots) as pool:
        return list(pool.map(lambda _: play(url, hz, seconds), range(robots)))


def play(url: str, hz: float, seconds: float) -> RobotBurst:
    """Run one robot. Ticks that pass during an act are skipped."""
    obs, acts, resumed, failed = observation(64, 1), [], 0, []
    with RemoteAgent(url, connect_timeout_s=_CONNECT_S, rank="robot") as agent:
        begun = time.time()
        try:
            agent.reset(obs, "let time pass")
        except VLAgentsError as error:
            return RobotBurst(time.time() - begun, [], 0, [f"reset: {error}"])
        reset_s, tick = time.time() - begun, time.time()
        until = tick + seconds
        while tick < until:
            asked = time.time()
            try:
                resumed += bool(agent.act(obs).info.get("resumed"))
                acts.append((time.time(), 1e3 * (time.time() - asked)))
            except VLAgentsError as error:
                failed.append(f"{type(error).__name__}: {error}")
            tick = max(tick + 1 / hz, time.time())
            time.sleep(max(0.0, tick - time.time()))
    return RobotBurst(reset_s, acts, resumed, failed)


def main() -> None:
    """Run the process."""
    die_with_parent()
    out = own_stdout()
    print(json.dumps("ready"), file=out, flush=True)
    for line in sys.stdin:
        print(json.dumps(burst(sys.argv[1], **json.loads(line))), file=out, flush=True)


if __name__ == "__main__":
    main()
