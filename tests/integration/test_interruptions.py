"""The longest time without an action after a replica is killed or frozen, or HAProxy is killed.

Robots act at 20 Hz over all transports at once, at a replica's own port or through the proxy, with
time limits far above these times: so no recovery here is caused by the time limit of a call.
"""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import psutil
import pytest
from eval_fakes import wait_for

from tests.integration.conftest import ROUTES, serving, states
from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client import connection
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.serve.launch.server import Server

REPLICAS = 2
ROBOTS = 4  # number of robots on each route
TIMEOUT_S = 60.0
FROZEN_S = 12.0  # time after which a frozen replica continues
FRAME = np.zeros((8, 8, 3), np.uint8)
FAULTS = ("kill", "freeze", "kill of HAProxy")
# A process reaches replicas either at their own ports or through the proxy: see `reach`.
ROUTES_AT_ONCE = {
    "own ports": [route for route, (_, is_proxied) in ROUTES.items() if not is_proxied],
    "proxied": [route for route, (_, is_proxied) in ROUTES.items() if is_proxied],
}

# The longest time without an action, in s: about twice the time needed on two shared cores. HAProxy
# restarts about 3 s after its end.
NEEDS_HAPROXY = ("websocket-proxied", "http-proxied")
PING_AFTER_S = 0.5


def bound_s(route: str, fault: str) -> float:
    """Return the longest allowed time without an action after a fault. It is the same for all
    routes that depend on the affected process.
    """
    if fault == "freeze":  # the clients have left by then
        return 2.4 * (PING_AFTER_S + connection.FROZEN_S)
    if fault == "kill":
        return 4.0
    return 12.0 if route in NEEDS_HAPROXY else 2.0


@dataclass
class Robot:
    """A session that acts at 20 Hz and records each answer."""

    route: str
    agent: RemoteAgent
    name: str
    pid: int = 0  # the process of its replica
    number: int = 0  # number of the latest observation
    answered: list[float] = field(default_factory=list)  # from time.monotonic(), in s
    # The observations on which a resumed session acted again, because their first answers were
    # lost.
    resumed: set[int] = field(default_factory=set)
    error: BaseException | None = None

    def begin(self) -> None:
        """Begin an episode."""
        self.pid = self.agent.reset(self.observation(-1), self.name)["pid"]

    def observation(self, number: int) -> Obs:
        return Obs({"front": FRAME}, info={"episode": self.name, "number": number})

    def act_until(self, stop: threading.Event) -> None:
        """Act until `stop` is set."""
        try:
            while not stop.wait(0.05):
                info = self.agent.act(self.observation(self.number)).info
                assert (info["episode"], info["number"]) == (self.name, self.number), "crossed"
                self.pid = info["pid"]
                if info.get("resumed"):
                    self.resumed.add(self.number)
                self.number += 1
                self.answered.append(time.monotonic())
        except BaseException as error:  # noqa: BLE001 - the test raises it
            self.error = error

    def longest_gap_s(self, since: float) -> float:
        """Return the longest time between two answers after `since`, including the time around
        `since`.
        """
        before = [moment for moment in self.answered if moment <= since][-1:]
        after = [moment for moment in self.answered if moment > since]
        moments = [*before, *after]
        return max(later - earlier for earlier, later in pairwise(moments))


@pytest.fixture(scope="module")
def server(shared_ray: None, ledger: Path) -> Iterator[Server]:
    with serving(
        "served_agents:Ledger", config={"folder": str(ledger)}, replicas=REPLICAS
    ) as server:
        yield server


def executed(ledger: Path, name: str) -> list[tuple[int, int, float]]:
    """Return the observations of a robot on which replicas acted: number, process, and
    time.monotonic().
    """
    acts = []
    for file in ledger.iterdir():
        for line in file.read_text().splitlines():
            at, session, episode, number = line.split()
            assert session == episode, "crossed"
            if episode == name:
                acts.append((int(number), int(file.name), int(at) / 1e9))
    return acts


def haproxy_processes() -> list[int]:
    """Return the HAProxy processes of this process's Ray."""
    folder = Path(os.environ["RAY_SERVE_HAPROXY_CONFIG_FILE_LOC"]).parent
    found = []
    for process in psutil.process_iter(["cmdline"]):
        words = process.info["cmdline"] or []
        is_ours = any(word.startswith(f"{folder}/") for word in words)
        if is_ours and Path(words[0]).name == "haproxy":
            found.append(process.pid)
    return found


def url_of(server: Server, transport: TransportName) -> str:
    """Return the clients' address for a transport."""
    return "serve://Ledger" if transport == "handle" else server.url


@contextmanager
def acting(server: Server, transports: Mapping[str, TransportName]) -> Iterator[list[Robot]]:
    """Yield robots of each route that are acting; each replica has some of them."""

    def new_agent(route: str) -> RemoteAgent:
        """Return a new client. Over HTTP, HAProxy chooses the replica by the client's random id,
        which the client keeps.
        """
        transport = transports[route]
        return RemoteAgent(url_of(server, transport), transport=transport, timeout_s=TIMEOUT_S)

    begun = time.monotonic_ns()
    robots = [
        Robot(route, new_agent(route), f"{route}-{begun}-{number}")
        for route in transports
        for number in range(ROBOTS)
    ]

    def are_spread() -> bool:
        for robot in robots:
            robot.agent.close()
        # All replicas get the same number of sessions. The order in which the sessions of a route
        # begin decides their replicas.
        for robot in random.sample(robots, len(robots)):
            robot.agent = new_agent(robot.route)
            robot.begin()
        reached = {(robot.route, robot.pid) for robot in robots}
        return len(reached) == len(transports) * REPLICAS

    wait_for(are_spread, 120)
    stop = threading.Event()
    threads = [threading.Thread(target=robot.act_until, args=(stop,)) for robot in robots]
    for thread in threads:
        thread.start()
    try:
        wait_for(lambda: all(len(robot.answered) > 20 or robot.error for robot in robots), 60)
        yield robots
    finally:
        stop.set()
        for thread in threads:
            thread.join()
        for robot in robots:
            robot.agent.close()


def have_acted_since(robots: list[Robot], moment: float) -> Callable[[], bool]:
    """Return whether each robot has acted on an observation made after `moment`."""

    def has_acted(robot: Robot) -> bool:
        answers_since = sum(answered_at > moment for answered_at in robot.answered)
        return robot.error is not None or answers_since > 5

    return lambda: all(map(has_acted, robots))


@pytest.mark.alone
@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("routes", ROUTES_AT_ONCE.values(), ids=ROUTES_AT_ONCE.keys())
def test_robots_act_again_soon_and_no_act_is_doubled_or_late(
    server: Server,
    ledger: Path,
    reach: Callable[[str], TransportName],
    routes: Sequence[str],
    fault: str,
) -> None:
    transports = {route: reach(route) for route in routes}
    wait_for(lambda: states("Ledger").get("RUNNING") == REPLICAS, 120)
    with acting(server, transports) as robots:
        hit = robots[0].pid
        victims = haproxy_processes() if fault == "kill of HAProxy" else [hit]
        assert victims
        began = time.monotonic()
        for pid in victims:
            os.kill(pid, signal.SIGSTOP if fault == "freeze" else signal.SIGKILL)
        try:
            left = robots if fault == "kill of HAProxy" else [r for r in robots if r.pid == hit]
            wait_for(have_acted_since(robots, began + 0.2), TIMEOUT_S)
            if fault != "kill of HAProxy":
                wait_for(lambda: all(robot.error or robot.pid != hit for robot in left), TIMEOUT_S)
            gaps_s = {}
            for route in routes:
                robots_of_route = [robot for robot in robots if robot.route == route]
                gaps_s[route] = max(robot.longest_gap_s(began) for robot in robots_of_route)
            if fault == "freeze":
                time.sleep(max(0.0, began + FROZEN_S - time.monotonic()))
        finally:
            with suppress(ProcessLookupError):
                os.kill(hit, signal.SIGCONT)
        time.sleep(2.0)  # the acts of the frozen replica are late now

    shown = ", ".join(f"{route} {gap_s:.1f} s" for route, gap_s in gaps_s.items())
    print(f"{fault}: {len(left)} robots hit, no action for: {shown}")
    assert not [robot.error for robot in robots if robot.error is not None]
    for robot in robots:
        acts = executed(ledger, robot.name)
        late = [act for act in acts if act[1] == hit and fault != "kill of HAProxy"]
        late = [act for act in late if act[2] > began + 0.5 and robot in left]
        assert not late, f"{robot.name}: executed after its robot had left: {late}"
        for process in {pid for _, pid, _ in acts}:
            numbers = [number for number, pid, _ in acts if pid == process]
            doubled = {number for number, times in Counter(numbers).items() if times > 1}
            assert doubled <= robot.resumed, (
                f"{robot.name}: executed twice: {doubled - robot.resumed}"
            )
    for route, gap_s in gaps_s.items():
        assert gap_s < bound_s(route, fault), f"{fault}: no action for: {shown}"


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.parametrize("route", ROUTES)
def test_a_session_stays_at_a_replica_whose_policy_is_slow(
    server: Server, reach: Callable[[str], TransportName], route: str
) -> None:
    """The first slow act follows fast ones. Another thread of the replica's process answers the
    pings.
    """
    transport = reach(route)
    wait_for(lambda: states("Ledger").get("RUNNING") == REPLICAS, 120)
    url = url_of(server, transport)
    with RemoteAgent(url, transport=transport, timeout_s=TIMEOUT_S) as agent:
        robot = Robot(route, agent, f"slow-{route}")
        robot.begin()
        for _ in range(20):
            agent.act(robot.observation(0))
        observation = robot.observation(1)
        observation.info["slow_s"] = 8.0
        act = agent.act(observation)
        assert act.info["pid"] == robot.pid
        assert act.info["acts"] == 21
        assert "resumed" not in act.info
        assert agent.act(robot.observation(2)).info["acts"] == 22
