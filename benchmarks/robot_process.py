"""Robots that execute the chunks of a policy at their rate: `python -m benchmarks.robot_process
JSON`, with a list of `Robot`.

The process connects its robots, and writes "ready". Each line that it then reads is a run,
{"begin": s, "counted": s, "end": s} of `time.monotonic`; at the end it writes the figures of each
robot's ticks since `counted`.

A robot with the chunk player whose policy is late holds still at that tick, and continues at the
next tick: the load does not decrease when the server is slow. A robot with a *waiting loop*
executes half of the rows of a chunk, and then waits for the next one. This is the loop of openpi
(`ActionChunkBroker` of `openpi-client`, with 5 of 10 rows in its example for LIBERO and 25 of 50 on
ALOHA) and of vlagents (`EvalEnv.chunk_step`), and the plainest one for a server that has no loop of
its own.
"""

from __future__ import annotations

import contextlib
import json
import math
import random
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from benchmarks.own_clients import observation
from vlagents_ray.chunking.fallback import Cause
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.interface import AGE_MS, CAUSE, CHUNK, IN_TIME, ROW, SAFE, Act, Agent, Obs
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.robot.pacing import Pacer
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout

OURS, RAY_SERVE, OPENPI, VLAGENTS = "vlagents_ray", "ray serve", "openpi", "vlagents"
Loop = Literal["player", "waiting"]
CONNECT_S = 120.0
_TIMEOUT_S = 20.0
_AGES = 2000  # maximum number of ages of a robot that are written
_OPENPI_KEYS = {
    "cameras": {"camera_0": "observation/image", "camera_1": "observation/wrist_image"},
    "state": {"joints": "observation/state"},
    "instruction": "prompt",
}
_VLAGENTS_KEYS = {
    "cameras": {"camera_0": "robot/cameras/camera_0", "camera_1": "robot/cameras/camera_1"},
    "state": {"joints": "robot/joints"},
    "gripper": "robot/gripper",
    "instruction": "language_instruction",
}
# The protocol and the keys of the systems to which `upstream` connects.
_UPSTREAMS = {OPENPI: ("openpi", _OPENPI_KEYS), VLAGENTS: ("vlagents", _VLAGENTS_KEYS)}


@dataclass(frozen=True, slots=True)
class Robot:
    """One robot."""

    url: str
    system: str  # one of `OURS`, `RAY_SERVE`, `OPENPI` and `VLAGENTS`
    hz: float
    chunk: int  # number of rows in an answer
    rows: int  # maximum number of rows of an answer that the robot executes
    loop: Loop = "player"


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
    if robot.system in _UPSTREAMS:
        protocol, keys = _UPSTREAMS[robot.system]
        settings = {
            "protocol": protocol,
            "urls": [robot.url],
            "mapping": keys,
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


def executed_by_waiting(rows: int) -> int:
    """Return the number of rows of a chunk that a waiting loop executes."""
    return max(1, rows // 2)


class Figures:
    """The figures of a robot since `counted`."""

    def __init__(self) -> None:
        self.ticks = 0.0
        self.late = 0.0  # ticks without an action, not counting waits that the loop chose
        self.missed = 0  # ticks that the robot's own process began too late; they are also late
        self.waits: list[float] = []  # ticks of each wait that the loop chose
        # Rows that were executed between the observation of each answer and its first row; infinite
        # for an answer that had no row left.
        self.delays: list[float] = []
        self.ages: list[float] = []  # age of each executed action, ms
        self.failed = ""  # the last error of the policy
        # Index of the last chunk of which a row was executed, also before `counted`.
        self._chunk: int | None = None
        self._is_waiting = False  # whether the last tick was a chosen wait

    def count(self, info: Mapping[str, Any], *, is_counted: bool) -> None:
        """Count a tick of the chunk player.

        Args:
            info: The info of the tick's action.
            is_counted: Whether the tick is since `counted`.
        """
        row = SAFE not in info
        if row:
            chunk: int = info[CHUNK]
            if chunk != self._chunk and is_counted:
                # The answers between them had no row left, and moved no robot.
                skipped = 0 if self._chunk is None else chunk - self._chunk - 1
                self.delays += [math.inf] * skipped + [info[ROW]]
            self._chunk = chunk
        if not is_counted:
            return

        self.ticks += 1
        # A tick without a row that is nevertheless in time, or needs no action of the policy, is a
        # wait that the player chose.
        is_waiting = not row and info.get(IN_TIME, True)
        if row:
            self.ages.append(info[AGE_MS])
        elif is_waiting:
            if not self._is_waiting:
                self.waits.append(0)
            self.waits[-1] += 1
        else:
            self.late += 1
            cause: Cause = info[CAUSE]
            if cause not in ("waiting", "late"):
                self.failed = info[SAFE]
        self._is_waiting = is_waiting

    def to_json(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        return {
            "ticks": self.ticks,
            "late": self.late,
            "missed": self.missed,
            "waits": self.waits,
            "delays": self.delays,
            "ages": self.ages if len(self.ages) <= _AGES else random.sample(self.ages, _AGES),
            "failed": self.failed,
        }


class RunningRobot:
    """A robot with its control loop."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        settings = PlayerSettings(mode="async", horizon=robot.rows, timeout_s=_TIMEOUT_S)
        if robot.loop == "waiting":
            execute = executed_by_waiting(robot.rows)
            settings = PlayerSettings(mode="open_loop", execute=execute, timeout_s=_TIMEOUT_S)
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
        figures = Figures()
        try:
            self._player.reset(replace(self._obs, info={}), "measure")
        except (VLAgentsError, OSError) as error:
            figures.ticks = figures.late = 1
            figures.failed = str(error)
            return figures.to_json()

        # A robot holds still while it waits for its first answer.
        waited_s = max(0.0, min(time.monotonic(), end) - counted)
        figures.ticks = figures.late = round(waited_s * hz)
        if self._robot.loop == "player":
            self._play(figures, counted, end)
        else:
            self._wait(figures, counted, end)
        return figures.to_json()

    def _play(self, figures: Figures, counted: float, end: float) -> None:
        """Execute a row at each tick; answers arrive in the background."""
        pacer = Pacer(self._robot.hz)
        missed_before = 0
        while (now := time.monotonic()) < end:
            pacer.wait()
            act = self._player.act(replace(self._obs, info={}))
            figures.count(act.info, is_counted=now >= counted)
            if now < counted:
                missed_before = pacer.missed
        figures.missed = pacer.missed - missed_before
        figures.ticks += figures.missed
        figures.late += figures.missed

    def _wait(self, figures: Figures, counted: float, end: float) -> None:
        """Execute a row at each step; the step that needs a new chunk waits for it.

        Each row takes a period. (openpi's `Runtime` makes up for up to one period of a wait, as it
        then sends two rows at once.)
        """
        hz = self._robot.hz
        step = time.monotonic()
        while step < end:
            time.sleep(max(0.0, step - time.monotonic()))
            act, failed = self._act()
            done = time.monotonic()
            is_counted = step >= counted
            if act is not None and act.info[ROW] > 0:
                figures.ticks += is_counted
                step = max(step + 1 / hz, done)
            else:
                waited = (done - step) * hz
                if is_counted:
                    figures.ticks += 1 + waited
                    if act is None:
                        figures.late += 1 + waited
                        figures.failed = failed
                    else:
                        figures.waits.append(waited)
                        figures.delays.append(0)
                step = done + 1 / hz
            if act is not None and is_counted:
                figures.ages.append(act.info[AGE_MS])

    def _act(self) -> tuple[Act | None, str]:
        """Return the next action, or None and an error of the policy."""
        try:
            return self._player.act(replace(self._obs, info={})), ""
        except (VLAgentsError, OSError) as error:
            return None, str(error)

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
