"""Measures round trips and CPU time of one `act` for our transports and other policy servers
(`peers`), in turns in one run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import typer

from benchmarks import peers as others
from benchmarks.console import Calls, Out, Transports, save, show_round_trips, show_use
from benchmarks.figures import measured_on
from benchmarks.own_clients import own_clients
from benchmarks.round_trips import measure
from vlagents_ray.cli.console import errors, progress
from vlagents_ray.cli.options import parse_list


def measure_with_peers(
    calls: int,
    *,
    peers: Sequence[str],
    peers_python: Path = others.PYTHON,
    transports: Sequence[str] = (),
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure round trips of our transports and of other policy servers.

    Args:
        calls: Number of round trips of each client.
        peers: Names of `peers.PEERS`, or "all"; a peer that is not installed is in "skipped", with
            the cure.
        peers_python: The Python in which they are installed.
        transports: Our transports; by default all.
        progress: Is called with lines of progress.

    Returns:
        The result of `benchmarks.round_trips.measure(...).to_json()`, and the "versions" of the
        peers' packages.
    """
    own = own_clients(transports)
    found, absent, versions = others.peer_clients(peers, peers_python)
    trips = measure(
        own, calls, progress, others=others.starters(found, peers_python), skipped=absent
    )
    return trips.to_json() | {"versions": versions}


def main(
    calls: Calls = 1000,
    transports: Transports = "",
    peers: others.Peers = "all",
    peers_python: others.PeersPython = others.PYTHON,
    out_file: Out = None,
) -> None:
    """Measure round trips and CPU time of calls on this machine: every transport, and other policy
    servers, interleaved.
    """
    with errors():
        origin = measured_on("python -m benchmarks.rtt")
        found = measure_with_peers(
            calls,
            peers=parse_list(peers),
            peers_python=peers_python,
            transports=parse_list(transports),
            progress=progress,
        )
        show_round_trips(found, "round trip of one act on this machine")
        show_use(found)
        save({**origin, **found, "versions": origin["versions"] | found["versions"]}, out_file)


if __name__ == "__main__":
    typer.run(main)
