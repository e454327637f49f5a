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

from vlagents_ray.bench.observing import observation, save
from vlagents_ray.bench.statistics import RoundTrips, ratios
from vlagents_ray.bench.ways import Driver, PeerWay, Way, connected, peer_connected, peer_ways, ways
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.cluster import free_port, running_server
from vlagents_ray.serve.files import deployment

__all__ = ["RoundTripsOfAll", "measure_rtt", "observation"]

POLICY = "vlagents_ray.bench.policy:Measured"
LOOPBACK = "127.0.0.1"
ROUND = 100  # calls of one way before it is the next one's turn
UNBROKEN = 200  # rounds' worth of calls without a break: a second or two
ON_NODE = ("shm", "plasma")


@dataclass(frozen=True, slots=True)
class RoundTripsOfAll:
    """What was measured, what was not and why."""

    ours: tuple[RoundTrips, ...]
    theirs: tuple[RoundTrips, ...] = ()
    skipped: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)  # of the peers' packages
    steady: tuple[RoundTrips, ...] = ()  # of the ways on the node, one after the other, each without a break
    psnr_db: Mapping[str, float | None] = field(default_factory=dict)  # of what the policy saw, by way; None: all of it

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
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
    tell: Callable[[str], None] = lambda _: None,
) -> RoundTripsOfAll:
    """`calls` round trips by each way (rounded up to whole rounds), on servers started for them.

    `transports` are those of ours, by default all. `peers` are names from `vlagents_ray.bench.ways.PEERS`, or
    "all"; one that is not installed for `peers_python` is in `skipped`, with the cure.
    """
    own, skipped = ways(transports)
    others, absent, versions = peer_ways(peers, peers_python)
    return measure(own, others, calls, peers_python, skipped | absent, versions, tell)


def measure(
    own: Sequence[Way],
    others: Sequence[PeerWay],
    calls: int,
    peers_python: Path,
    skipped: Mapping[str, str],
    versions: Mapping[str, str],
    tell: Callable[[str], None],
    *,
    host: str = LOOPBACK,
    prefix: Sequence[str] = (),
) -> RoundTripsOfAll:
    """All ways against servers on `host`; the commands of the clients begin with `prefix`."""
    drivers: dict[str, Driver] = {}
    with contextlib.ExitStack() as stack:
        obs = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "observation.npz"
        save(observation(), obs)
        for peer in others:  # before Ray, whose start is what takes the time
            way = peer_connected(peer, peers_python, host, free_port(host), obs, prefix)
            drivers[peer.name] = stack.enter_context(way)
        # Without keys: another host than loopback is one end of a link that only this run knows.
        server = stack.enter_context(running_server(deployment(POLICY), host=host, insecure=host != LOOPBACK))
        [(app, url)] = server.apps.items()
        for one in own:
            drivers[one.name] = stack.enter_context(connected(one, url, app, prefix))
        if not drivers:
            raise ConfigError("nothing to measure: want a transport or a peer")
        said = {name: driver.ready() for name, driver in drivers.items()}
        found = in_turns(drivers, calls, tell)
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


def in_turns(drivers: Mapping[str, Driver], calls: int, tell: Callable[[str], None]) -> dict[str, RoundTrips]:
    """Rounds of at most 100 calls of each until everyone has made `calls`; the order is drawn anew each time."""
    each = min(ROUND, calls)
    rounds = -(-calls // each)
    taken: dict[str, list[list[float]]] = {name: [] for name in drivers}
    order = list(drivers)
    for number in range(rounds):
        random.Random(number).shuffle(order)
        for name in order:
            taken[name].append(drivers[name].measure(each))
        tell(f"{(number + 1) * each} of {rounds * each} calls by each way")
    return {name: RoundTrips(name, np.array(ms)) for name, ms in taken.items()}
