"""Robots that execute the chunks of a policy at their rate: `python -m benchmarks.robot_process
JSON`, with a list of `Robot`.

The process connects its robots, and writes "ready". Each line that it then reads is a run,
{"begin": s, "counted": s, "end": s} of `time.monotonic`; at the end it writes the figures of each
robot's ticks since `counted`. A robot whose policy is late holds still at that tick, and continues
at the next tick: the load does not decrease when the server is slow.
"""

from __future__ import annotations

import contextlib
import json
import random
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.own_clients import observation
from vlagents_ray.chunking.fallback import Cause
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.interface import AGE_MS, CAUSE, SAFE, Act, Agent, Obs
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.robot.pacing import Pacer
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout

OURS, RAY_SERVE, OPENPI = "vlagents_ray", "ray serve", "openpi"
CONNECT_S = 120.0
_TIMEOUT_S = 20.0
_AGES = 2000  # maximum number of ages of a robot that are written
_OPENPI_KEYS = {
    "cameras": {"camera_0": "observation/image", "camera_1": "observation/wrist_image"},
    "state": {"joints": "observation/state"},
    "instruction": "prompt",
}


@dataclass(frozen=True, slots=True)
class Robot:
    """One robot."""

    url: str
    system: str  # one of `OURS`, `RAY_SERVE` and `OPENPI`
    hz: float
    chunk: int  # number of rows in an answer
    rows: int  # maximum number of rows of an answer that the robot executes


class RayServeClient(Agent):
    """A client of plain Ray Serve with `@serve.batch`, `benchmarks/peers/ray_serve_peer.py`."""

    def __init__(self, url: str, chunk: int) -> None:
        import requests  # robots of other servers do not need this module

        self._url, self._chunk = url, chunk
        self._connection = requests.Session()

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=7, delta=True), chunk=self._chunk)

    def act(self, obs: Obs) -> Act:
        import msgpack

        arrays = {**obs.cameras, **obs.state}
        packed = {
            name: (array.tobytes(), str(array.dtype), array.shape) for name, array in arrays.items()
        }
        answer = self._connection.post(self._url, msgpack.packb(packed), timeout=_TIMEOUT_S)
        answer.raise_for_status()
        return Act(np.frombuffer(answer.content, np.float32).reshape(self._chunk, 7))

    def close(self) -> None:
        self._connection.close()


def connect(robot: Robot) -> Agent:
    """Return the client of a robot, not connected yet."""
    if robot.system == RAY_SERVE:
        return RayServeClient(robot.url, robot.chunk)
    if robot.system == OPENPI:
        settings = {
            "protocol": "openpi",
            "urls": [robot.url],
            "mapping": _OPENPI_KEYS,
            "contract": {"action": {"dim": 7, "delta": True}, "chunk": robot.chunk},
            "timeout_s": _TIMEOUT_S,
        }
        return build_agent("upstream", settings)
    return RemoteAgent(
        robot.url,
        transport="websocket",
        codec="jpeg",
        timeout_s=_TIMEOUT_S,
        connect_timeout_s=CONNECT_S,
    )


class RunningRobot:
    """A robot with its player."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        settings = PlayerSettings(mode="async", horizon=robot.rows, timeout_s=_TIMEOUT_S)
        self._player = ChunkPlayer(connect(robot), settings)
        self._player.initialize()
        self._obs = observation()

    def run(self, begin: float, counted: float, end: float) -> dict[str, Any]:
        """Run from a random moment within a period after `begin` until `end`, and return the
        figures.

        Args:
            begin: The beginning of the episode; all times are s of `time.monotonic`.
            counted: The time since which ticks are counted, as the figures of robots that have just
                started together differ from later figures.
            end: The end of the run.
        """
        hz = self._robot.hz
        time.sleep(max(0.0, begin + random.uniform(0, 1 / hz) - time.monotonic()))
        failed = ""
        ages: list[float] = []
        try:
            self._player.reset(replace(self._obs, info={}), "measure")
        except VLAgentsError as error:
            return {"ticks": 1, "late": 1, "missed": 0, "ages": [], "failed": str(error)}

        # A robot holds still while it waits for its first answer.
        waited_s = max(0.0, min(time.monotonic(), end) - counted)
        ticks = late = round(waited_s * hz)
        pacer = Pacer(hz)
        missed_before = 0
        while (now := time.monotonic()) < end:
            pacer.wait()
            act = self._player.act(replace(self._obs, info={}))
            if now < counted:
                missed_before = pacer.missed
                continue

            ticks += 1
            if SAFE not in act.info:
                ages.append(act.info[AGE_MS])
                continue
            late += 1
            cause: Cause = act.info[CAUSE]
            if cause not in ("waiting", "late"):
                failed = act.info[SAFE]
        missed = pacer.missed - missed_before
        return {
            "ticks": ticks + missed,
            "late": late + missed,
            "missed": missed,
            "ages": ages if len(ages) <= _AGES else random.sample(ages, _AGES),
            "failed": failed,
        }

    def close(self) -> None:
        """Close the connection."""
        self._player.close()


def main(text: str) -> None:
    """Run the process."""
    die_with_parent()
    out = own_stdout()
    robots = [Robot(**each) for each in json.loads(text)]
    with contextlib.ExitStack() as stack:
        threads = stack.enter_context(ThreadPoolExecutor(len(robots)))
        running: Sequence[RunningRobot] = [
            stack.enter_context(contextlib.closing(RunningRobot(robot))) for robot in robots
        ]
        print(json.dumps("ready"), file=out, flush=True)
        for line in sys.stdin:
            run = partial(RunningRobot.run, **json.loads(line))
            figures = list(threads.map(run, running))
            print(json.dumps(figures), file=out, flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
