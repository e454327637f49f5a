"""Measures round trips of one `act` with every transport, interleaved in one run.

The observation is the same as in the paper's measurement: two 224x224 RGB cameras and seven joints.
All clients take turns in short rounds, in a new random order each time, so that other load on the
machine affects them alike. Every client is a process (those that need Ray, an actor); every server
keeps running, and idles between its turns. Each turn therefore begins cold, which affects the 99th
percentile; at the end the clients on the node also make calls without a break. CPU time and context
switches of client and server are counted around each turn.
"""

from __future__ import annotations

import contextlib
import os
import random
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.drivers import Driver, ProcessDriver
from benchmarks.figures import RoundTrips, lost_db, ratios
from benchmarks.own_clients import OwnClient, connected, observation, save_observation
from benchmarks.processes import UsageMeter, count_idle, server_processes
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.policies.noop import Noop
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

POLICY = "benchmarks.round_trips:MeasuredNoop"
ROUND = 100  # number of calls of one client in its turn
UNBROKEN = 200  # calls without a break as a number of rounds; they take a second or two
ON_NODE = ("shm", "plasma")

# Is called with the file of the observation.
StartClient = Callable[[Path], AbstractContextManager[ProcessDriver]]


class MeasuredNoop(Noop):
    """The policy of the round trips: `reset` also returns the loss of the images' codec.

    The loss is {"psnr_db"}, computed from the cameras and the observation of the benchmark; None if
    they are equal.
    """

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {"psnr_db": lost_db(obs.cameras, observation().cameras)}


@dataclass(frozen=True, slots=True)
class RoundTripsOfAll:
    """The round trips of all measured clients, and the reasons for skipped clients."""

    ours: tuple[RoundTrips, ...]
    theirs: tuple[RoundTrips, ...] = ()
    skipped: Mapping[str, str] = field(default_factory=dict)
    steady: tuple[RoundTrips, ...] = ()  # round trips of clients on the node, each without a break
    # Quality of the images by client; None if lossless.
    psnr_db: Mapping[str, float | None] = field(default_factory=dict)
    # Use of resources per call by client; see `MeteredDriver.per_act`.
    use: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return {
            "ways": [
                {**trips.to_json(), "psnr_db": self.psnr_db.get(trips.name)} for trips in self.ours
            ],
            "peers": [trips.to_json() for trips in self.theirs],
            "ratios": ratios(self.ours, self.theirs),
            "steady": [trips.to_json() for trips in self.steady],
            "use": dict(self.use),
            "skipped": dict(self.skipped),
        }


class MeteredDriver:
    """A driver that also counts the resources of a call: CPU time and context switches.

    Args:
        driver: A driver that is ready.
        server: The processes of the client's server.
    """

    def __init__(self, driver: ProcessDriver, server: Sequence[int]) -> None:
        self._driver, self._acts = driver, 0
        self.client, self.server = UsageMeter([driver.pid]), UsageMeter(server)

    def ready(self) -> dict[str, Any]:
        """Return nothing: the driver is ready."""
        return {}

    def measure(self, calls: int) -> list[float]:
        """Make calls, and return their durations, ms."""
        with self.server.counting(), self.client.counting():
            taken = self._driver.measure(calls)
        self._acts += calls
        return taken

    def per_act(self) -> dict[str, Any]:
        """Return the use of client and server per call so far; see `UsageMeter.per_act`."""
        return {
            "client": self.client.per_act(self._acts),
            "server": self.server.per_act(self._acts),
        }


def metered(drivers: Mapping[str, ProcessDriver]) -> dict[str, MeteredDriver]:
    """Count the resources of the calls of ready drivers, in excess of the use of the same processes
    while they are idle.
    """
    others = [
        pid for one in drivers.values() for pid in (one.pid, one.server_pid) if pid is not None
    ]
    ours = server_processes(os.getpid(), others)
    found = {}
    for name, one in drivers.items():
        server = ours
        if one.server_pid is not None:
            server = sorted({one.server_pid, *server_processes(one.server_pid)} - {one.pid})
        found[name] = MeteredDriver(one, server)
    count_idle([meter for one in found.values() for meter in (one.client, one.server)])
    return found


def measure(
    own: Sequence[OwnClient],
    calls: int,
    progress: Callable[[str], None],
    *,
    others: Mapping[str, StartClient] | None = None,
    skipped: Mapping[str, str] | None = None,
) -> RoundTripsOfAll:
    """Measure our clients, and the clients in `others` with their own servers, interleaved."""
    others = others or {}
    drivers: dict[str, ProcessDriver] = {}
    with contextlib.ExitStack() as stack:
        obs = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "observation.npz"
        save_observation(observation(), obs)
        for name, start in others.items():  # started before Ray, whose start takes longest
            drivers[name] = stack.enter_context(start(obs))
        server = stack.enter_context(running_server(deployment(POLICY)))
        [(app, url)] = server.apps.items()
        for one in own:
            drivers[one.name] = stack.enter_context(connected(one, url, app))
        if not drivers:
            raise ConfigError("nothing to measure: expected a transport or another server")
        said = {name: driver.ready() for name, driver in drivers.items()}
        meters = metered(drivers)
        found = in_turns(meters, calls, progress)
        use = {name: one.per_act() for name, one in meters.items()}
        steady = [
            RoundTrips(
                one.name, np.array([drivers[one.name].measure(UNBROKEN * min(ROUND, calls))])
            )
            for one in own
            if one.transport in ON_NODE
        ]
    return RoundTripsOfAll(
        tuple(found[one.name] for one in own),
        tuple(found[name] for name in others),
        skipped or {},
        tuple(steady),
        {one.name: said[one.name]["psnr_db"] for one in own},
        use,
    )


def in_turns(
    drivers: Mapping[str, Driver], calls: int, progress: Callable[[str], None]
) -> dict[str, RoundTrips]:
    """Run turns of at most 100 calls until all clients have made `calls`, in a new random order
    each time.
    """
    each = min(ROUND, calls)
    rounds = -(-calls // each)
    taken: dict[str, list[list[float]]] = {name: [] for name in drivers}
    order = list(drivers)
    for number in range(rounds):
        random.Random(number).shuffle(order)
        for name in order:
            taken[name].append(drivers[name].measure(each))
        progress(f"{(number + 1) * each} of {rounds * each} calls by each way")
    return {name: RoundTrips(name, np.array(ms)) for name, ms in taken.items()}
