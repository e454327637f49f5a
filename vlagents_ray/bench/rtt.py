"""Round trips of one `act`: every transport of ours, and the peers' servers, interleaved in one run.

The observation is that of the paper's measurement: two 224x224 RGB cameras and seven joints. All ways
take turns in short rounds, in an order drawn anew each time, so that whatever else the machine does hits
them alike. Every client is a process of its own (those that need Ray, an actor); every server stays up
and idle while it is not its turn. So each turn begins cold, which is what the 99th percentile then shows: the ways on
the node make calls without a break, too, at the end.
"""

from __future__ import annotations

import contextlib
import random
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.bench.clients import OwnClient, connected, observation, own_clients, save_observation
from vlagents_ray.bench.figures import RoundTrips, lost_db, ratios
from vlagents_ray.bench.line_process import Driver
from vlagents_ray.bench.peers import PeerClient, peer_clients, peer_connected
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.policies.noop import Noop
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import free_port, running_server

POLICY = "vlagents_ray.bench.rtt:MeasuredNoop"
LOOPBACK = "127.0.0.1"
ROUND = 100  # calls of one way before it is the next one's turn
UNBROKEN = 200  # rounds' worth of calls without a break: a second or two
ON_NODE = ("shm", "plasma")


class MeasuredNoop(Noop):
    """The policy of the round trips: `reset` also returns what the images lost on the way.

    That is {"psnr_db"}: of the cameras, against the observation of the benchmark; None if they are the same.
    """

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {"psnr_db": lost_db(obs.cameras, observation().cameras)}


@dataclass(frozen=True, slots=True)
class RoundTripsOfAll:
    """The round trips of all clients that were measured, and why others were not."""

    ours: tuple[RoundTrips, ...]
    theirs: tuple[RoundTrips, ...] = ()
    skipped: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)  # of the peers' packages
    steady: tuple[RoundTrips, ...] = ()  # of the ways on the node, one after the other, each without a break
    psnr_db: Mapping[str, float | None] = field(default_factory=dict)  # of what the policy saw, by way; None: all of it

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "ways": [{**trips.to_json(), "psnr_db": self.psnr_db.get(trips.name)} for trips in self.ours],
            "peers": [trips.to_json() for trips in self.theirs],
            "ratios": ratios(self.ours, self.theirs),
            "steady": [trips.to_json() for trips in self.steady],
            "skipped": dict(self.skipped),
            "versions": dict(self.versions),
        }


def measure_rtt(
    calls: int = 1000,
    *,
    transports: Sequence[str] = (),
    peers: Sequence[str] = (),
    peers_python: Path = Path("python"),
    progress: Callable[[str], None] = lambda _: None,
) -> RoundTripsOfAll:
    """Measure `calls` round trips of each client (rounded up to whole rounds), on servers started for them.

    `transports` are those of ours, by default all. `peers` are names from `vlagents_ray.bench.peers.PEERS`, or
    "all"; one that is not installed for `peers_python` is in `skipped`, with the cure.
    """
    own, skipped = own_clients(transports)
    others, absent, versions = peer_clients(peers, peers_python)
    return measure(own, others, calls, peers_python, skipped | absent, versions, progress)


def measure(
    own: Sequence[OwnClient],
    others: Sequence[PeerClient],
    calls: int,
    peers_python: Path,
    skipped: Mapping[str, str],
    versions: Mapping[str, str],
    progress: Callable[[str], None],
    *,
    host: str = LOOPBACK,
    prefix: Sequence[str] = (),
) -> RoundTripsOfAll:
    """Measure all clients against servers on `host`; the commands of the clients begin with `prefix`."""
    drivers: dict[str, Driver] = {}
    with contextlib.ExitStack() as stack:
        obs = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "observation.npz"
        save_observation(observation(), obs)
        for peer in others:  # before Ray, whose start is what takes the time
            client = peer_connected(peer, peers_python, host, free_port(host), obs, prefix)
            drivers[peer.name] = stack.enter_context(client)
        # Without keys: another host than loopback is one end of a link that only this run knows.
        server = stack.enter_context(running_server(deployment(POLICY), host=host, insecure=host != LOOPBACK))
        [(app, url)] = server.apps.items()
        for one in own:
            drivers[one.name] = stack.enter_context(connected(one, url, app, prefix))
        if not drivers:
            raise ConfigError("nothing to measure: want a transport or a peer")
        said = {name: driver.ready() for name, driver in drivers.items()}
        found = in_turns(drivers, calls, progress)
        steady = [
            RoundTrips(one.name, np.array([drivers[one.name].measure(UNBROKEN * min(ROUND, calls))]))
            for one in own
            if one.transport in ON_NODE
        ]
    return RoundTripsOfAll(
        tuple(found[one.name] for one in own),
        tuple(found[peer.name] for peer in others),
        skipped,
        versions,
        tuple(steady),
        {one.name: said[one.name]["psnr_db"] for one in own},
    )


def in_turns(drivers: Mapping[str, Driver], calls: int, progress: Callable[[str], None]) -> dict[str, RoundTrips]:
    """Let each client make at most 100 calls in turn until all have made `calls`, in a new random order each time."""
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
