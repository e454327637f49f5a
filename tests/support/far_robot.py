"""A robot far from its policy, which records each tick, and the policy behind the endpoints of a
replica, each in a process.

`python far_robot.py drive URL` answers each line, {"seconds": 20}, with a line when the loop
begins, and with its record when the loop ends. `python far_robot.py serve PORT` answers each line
with the numbers of current and of opened sessions.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.interface import SAFE, Act, Agent, Obs
from vlagents_ray.robot.guard import Guard
from vlagents_ray.robot.loop import LoopOptions, run_loop
from vlagents_ray.robot.simulated import SimulatedRobot
from vlagents_ray.robot.watchdog import Watchdog
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout

HZ = 30.0
CHUNK = 50  # number of rows, which last 1.7 s
RESET_S, ACT_S = 10.0, 2.0  # time limits of the client, s
MAX_AGE_S = 3.0  # maximum age of the observation of an action that is executed, s
SILENCE_S = 2.0  # time without an answer after which the watchdog stops the robot, s
MAX_STEP = 0.2  # maximum step of the guard
_TURN = 2 * np.pi / (4 * HZ)  # change of the path's angle in a tick, rad: one round takes 4 s
_SWAY = 0.03  # distance of the paths of two chunks
_IMAGE = 224  # size of images, px
_COMPUTING_S = 0.06  # duration of a batch, s


class FarPolicy(Agent):
    """Moves along a sine, with chunks that differ slightly from each other, like those of a real
    policy.

    A row contains the position, the tick of its observation, and the number of observations that
    arrived twice.
    """

    def __init__(self) -> None:
        self._seen: set[int] = set()
        self._twice = 0
        self._random = np.random.default_rng(0)

    @property
    def contract(self) -> Contract:
        cameras = dict.fromkeys(("front", "wrist"), CameraSpec(_IMAGE, _IMAGE))
        state = {"ticks": StateSpec(2)}
        return Contract(
            cameras=cameras, state=state, action=ActionSpec(dim=3, delta=False), chunk=CHUNK
        )

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode."""
        self._seen, self._twice = set(), 0
        return {}

    def act(self, obs: Obs) -> Act:
        """Return a chunk, (50, 3) float32."""
        time.sleep(_COMPUTING_S)
        tick, executed = (int(number) for number in obs.state["ticks"])
        self._twice += tick in self._seen
        self._seen.add(tick)
        path = np.sin(_TURN * (executed + np.arange(CHUNK))) + self._random.uniform(-_SWAY, _SWAY)
        rows = np.stack([path, np.full(CHUNK, tick), np.full(CHUNK, self._twice)], -1).astype(
            np.float32
        )
        return Act(rows)


@dataclass(slots=True)
class Ticks:
    """The record of each tick of a run. The first tick is the reset's observation."""

    at_s: list[float] = field(default_factory=list)  # beginning of the tick, s of `time.monotonic`
    acted: list[bool] = field(default_factory=list)  # whether the policy's action was executed
    # Age of the observation behind each executed action of the policy, s.
    age_ticks: list[int] = field(default_factory=list)
    twice: int = 0  # number of observations that the policy received twice in one session


class FarRobot(SimulatedRobot):
    """A simulated robot that records its ticks and executed actions."""

    def __init__(self, contract: Contract | None) -> None:
        super().__init__(contract)
        self.ticks = Ticks()

    def observe(self) -> Obs:
        """Begin a tick."""
        obs = super().observe()
        obs.state["ticks"] = np.array([len(self.ticks.at_s), sum(self.ticks.acted)], np.float32)
        self.ticks.at_s.append(time.monotonic())
        self.ticks.acted.append(False)
        return obs

    def here(self, obs: Obs) -> np.ndarray:
        """Return the action that holds the robot's position, also before the first action of the
        policy.
        """
        return np.array([self._joints[0], *obs.state["ticks"]], np.float32)

    def note(self, act: Act) -> None:
        """Record an action of the policy that is about to be executed."""
        ticks = self.ticks
        ticks.acted[-1] = True
        _, tick, twice = (int(number) for number in act.action)
        ticks.age_ticks.append(len(ticks.at_s) - 1 - tick)
        ticks.twice = twice


class NotingPlayer(ChunkPlayer):
    """A chunk player that records the policy's actions at the robot."""

    robot: FarRobot

    def act(self, obs: Obs) -> Act:
        """Return the action of this tick."""
        act = super().act(obs)
        if SAFE not in act.info:
            self.robot.note(act)
        return act


class NotingAgent(RemoteAgent):
    """A client that counts the answers before which the session had to begin again, including
    answers that the player drops because the robot was stopped in the meantime.
    """

    resumed = 0

    def act(self, obs: Obs) -> Act:
        """Return the policy's answer."""
        act = super().act(obs)
        self.resumed += bool(act.info.get("resumed"))
        return act


def drive(url: str, seconds: float, began: Callable[[], object]) -> dict[str, Any]:
    """Run the robot with the policy, and return the record.

    The run ends when the policy has controlled the robot for a second since a stop, at the latest
    after `seconds`.
    """
    with NotingAgent(url, timeout_s=RESET_S) as agent:
        robot = FarRobot(agent.contract)
        low, high = np.array([-1.1, 0, 0]), np.array([1.1, 1e6, 1e6])
        guard = Guard(agent.contract, low=low, high=high, max_step=np.array([MAX_STEP, 1e6, 1e6]))
        watchdog = Watchdog(lambda _: robot.stop(), {"server": SILENCE_S, "loop": 1.0})
        # With a deadline of 0, no tick waits for the network.
        settings = PlayerSettings(
            mode="async", deadline_s=0, safe=robot.here, max_age_s=MAX_AGE_S, timeout_s=ACT_S
        )
        player = NotingPlayer(agent, settings, check=guard)
        player.robot = robot
        ends = float("inf")

        def until() -> bool:
            nonlocal ends
            if ends == float("inf"):
                ends = time.monotonic() + seconds
                began()
            recovered = bool(watchdog.barks) and all(robot.ticks.acted[-round(HZ) :])
            return recovered or time.monotonic() >= ends

        report = run_loop(
            robot,
            player,
            hz=HZ,
            instruction="go round",
            watchdog=watchdog,
            until=until,
            options=LoopOptions(real_time=True),
        )
        found = {
            "ticks": asdict(robot.ticks),
            "safe": {**report.safe, "waiting": report.waiting},
            "barks": report.barks,
            "resumed": agent.resumed,
        }
        player.close()
    return found


def run_robot(url: str, say: Callable[[Any], None]) -> None:
    """Run the robot's process until its standard input ends."""
    say("ready")
    for line in sys.stdin:
        say(drive(url, **json.loads(line), began=lambda: say("begun")))


def serve(port: int, say: Callable[[Any], None]) -> None:
    """Run the server's process, without Ray, until its standard input ends."""
    import uvicorn

    from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
    from vlagents_ray.serve.access.api_keys import NoKey
    from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
    from vlagents_ray.serve.endpoints.http import build_http_app
    from vlagents_ray.serve.endpoints.own_port import OwnPortServer
    from vlagents_ray.serve.engine.engine import Engine
    from vlagents_ray.serve.ports import EVERYWHERE

    policy = FarPolicy()
    engine = Engine(policy)
    stream = OwnPortServer(engine, DEFAULT_LIMITS, EVERYWHERE, None, NoKey.OPEN)
    stream.open()
    engine.start()
    metadata = {
        "policy": "far",
        "version": "0",
        "protocol": PROTOCOL_VERSION,
        "stream": asdict(stream.address),
        "contract": policy.contract.to_json(),
    }
    app = AccessMiddleware(build_http_app(engine, lambda: metadata, DEFAULT_LIMITS), None, "far")
    config = uvicorn.Config(app, host=EVERYWHERE, port=port, log_level="warning")
    threading.Thread(target=uvicorn.Server(config).run, daemon=True).start()
    # Clients that connect before uvicorn has started try again.
    say("ready")
    for _ in sys.stdin:
        say([len(engine.sessions), engine.sessions.opened])
    os._exit(0)  # the server ends even if clients are still connected


def main() -> None:
    """Run one of the two processes."""
    die_with_parent()
    out = own_stdout()

    def say(line: Any) -> None:
        print(json.dumps(line), file=out, flush=True)

    command, argument = sys.argv[1:]
    if command == "serve":
        serve(int(argument), say)
    else:
        run_robot(argument, say)


if __name__ == "__main__":
    main()
