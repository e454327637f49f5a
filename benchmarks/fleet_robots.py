"""Robots that execute the chunks of a policy at their rate: `python -m benchmarks.fleet_robots
JSON`.

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
from benchmarks.photographs import with_photographs
from vlagents_ray.chunking.fallback import Cause
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.interface import AGE_MS, CAUSE, CHUNK, REPLAN, SAFE, SLACK, Act, Agent, Obs
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.robot.pacing import Pacer
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout
from vlagents_ray.testing import random_observation

CONNECT_S = 120.0
TIMEOUT_S = 20.0
_AGES = 2000  # maximum number of ages of a robot that are written
_IMAGE_SIZE = 224  # size of cameras for which the contract has no size, px
_OPENPI_KEYS = {
    "cameras": {"camera_0": "observation/image", "camera_1": "observation/wrist_image"},
    "state": {"joints": "observation/state"},
    "instruction": "prompt",
}
_VLAGENTS_KEYS = {
    "cameras": {name: f"robot/cameras/{name}" for name in ("camera_0", "camera_1")},
    "state": {"joints": "robot/joints"},
    "instruction": "language_instruction",
}


@dataclass(frozen=True, slots=True)
class Robot:
    """One robot."""

    url: str
    hz: float
    chunk: int  # number of rows in an answer
    # Maximum number of rows of an answer that the robot executes; None for all.
    rows: int | None = None
    way: str = "websocket"  # transport of our client; otherwise "openpi", "vlagents" or "ray serve"
    states_slack: bool = True  # whether the robot reports how long it can wait for an answer
    real_time_chunking: bool = False
    age_ms: float | None = None  # maximum age of an action in the robot's SLO
    share: float = 0.98  # share of ticks in time in the robot's SLO
    # Whether the observations fit the contract of the policy; otherwise they have two cameras and
    # seven joints.
    fits_contract: bool = False


class WithoutSlack(Agent):
    """Our client as it was before servers used slack."""

    def __init__(self, agent: Agent) -> None:
        self._agent = agent

    @property
    def contract(self) -> Contract | None:
        return self._agent.contract

    def initialize(self) -> None:
        self._agent.initialize()

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        kwargs.pop("slo", None)
        return self._agent.reset(obs, instruction, **kwargs)

    def act(self, obs: Obs) -> Act:
        info = {key: value for key, value in obs.info.items() if key != SLACK}
        act = self._agent.act(replace(obs, info=info))
        act.info.pop(REPLAN, None)
        return act

    def close(self) -> None:
        self._agent.close()


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
        answer = self._connection.post(self._url, msgpack.packb(packed), timeout=TIMEOUT_S)
        answer.raise_for_status()
        return Act(np.frombuffer(answer.content, np.float32).reshape(self._chunk, 7))

    def close(self) -> None:
        self._connection.close()


def connect(robot: Robot) -> Agent:
    """Return the client of a robot, not connected yet."""
    if robot.way == "ray serve":
        return RayServeClient(robot.url, robot.chunk)
    if robot.way in ("openpi", "vlagents"):
        settings = {
            "protocol": robot.way,
            "urls": [robot.url],
            "mapping": _OPENPI_KEYS if robot.way == "openpi" else _VLAGENTS_KEYS,
            "contract": {"action": {"dim": 7, "delta": True}, "chunk": robot.chunk},
            "timeout_s": TIMEOUT_S,
        }
        return build_agent("upstream", settings)
    agent = RemoteAgent(
        robot.url,
        transport=robot.way,  # type: ignore[arg-type]
        codec="jpeg",
        timeout_s=TIMEOUT_S,
        connect_timeout_s=CONNECT_S,
    )
    return agent if robot.states_slack else WithoutSlack(agent)


class RunningRobot:
    """A robot with its player."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        agent = connect(robot)
        contract = agent.contract
        is_relative = contract is not None and bool(contract.action.relative)
        settings = PlayerSettings(
            mode="async",
            horizon=robot.rows,
            real_time_chunking=robot.real_time_chunking,
            timeout_s=TIMEOUT_S,
            # The arm does not move, but the player rejects actions that do not fit the contract.
            safe="zero" if is_relative else "hold",
        )
        self._player = ChunkPlayer(agent, settings)
        self._player.initialize()
        self._obs = observation()
        if robot.fits_contract:
            obs = random_observation(agent.contract, seed=0, image_size=_IMAGE_SIZE)
            self._obs = with_photographs(obs, seed=0)

    def run(self, begin: float, counted: float, end: float) -> dict[str, Any]:
        """Run from a random moment within a period after `begin` until `end`, and return the
        figures.

        Args:
            begin: The beginning of the episode; all times are s of `time.monotonic`.
            counted: The time since which ticks are counted, as the figures of a starting fleet
                differ from those of a running fleet.
            end: The end of the run.
        """
        robot = self._robot
        slo = {"hz": robot.hz, "age_ms": robot.age_ms, "share": robot.share}
        known = {key: value for key, value in slo.items() if value is not None}
        options = {"slo": known} if robot.way in ("websocket", "http", "shm") else {}
        time.sleep(max(0.0, begin + random.uniform(0, 1 / robot.hz) - time.monotonic()))
        failed = ""
        ages: list[float] = []
        resumed: set[int] = set()  # number of chunks before which the session had to begin again
        # Times of starved ticks, s after `begin`, and their numbers.
        late: list[tuple[float, int]] = []
        try:
            reset = self._player.reset(replace(self._obs, info={}), "measure", **options)
        except VLAgentsError as error:
            return {
                "ticks": 1,
                "starved": 1,
                "missed": 0,
                "ages": [],
                "late": [],
                "resumed": 0,
                "failed": str(error),
            }

        # A robot holds still while it waits for its first answer.
        waited_s = max(0.0, min(time.monotonic(), end) - counted)
        ticks = starved = round(waited_s * robot.hz)
        pacer = Pacer(robot.hz)
        missed_before = 0
        while (now := time.monotonic()) < end:
            tick = pacer.wait()
            act = self._player.act(replace(self._obs, info={}))
            if now < counted:
                missed_before = pacer.missed
                continue

            ticks += 1
            if act.info.get("resumed"):
                resumed.add(act.info[CHUNK])
            if SAFE not in act.info:
                ages.append(act.info[AGE_MS])
                continue
            starved += 1
            late.append((time.monotonic() - begin, tick))
            cause: Cause = act.info[CAUSE]
            if cause not in ("waiting", "late"):
                failed = act.info[SAFE]
        missed = pacer.missed - missed_before
        return {
            "ticks": ticks + missed,
            "starved": starved + missed,
            "missed": missed,
            "ages": ages if len(ages) <= _AGES else random.sample(ages, _AGES),
            "late": late,
            "resumed": len(resumed),
            "failed": failed,
            "slo": reset.get("slo"),
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
