"""Thousands of sessions begin and end without leaving resources behind."""

from __future__ import annotations

import gc
import itertools
import os
from contextlib import suppress

import numpy as np
import psutil
import pytest
import shared_ray
from eval_fakes import wait_for
from open_resources import unpooled_threads

from tests.integration.conftest import serving
from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.transports.base import CodecName
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.serve.launch.server import Server

pytestmark = pytest.mark.integration

# Numbers of sessions for which a leak of one or two kilobytes per session is visible.
# VLAGENTS_SESSIONS=N opens N sessions with each transport.
SESSIONS: dict[TransportName, int] = {
    "shm": 2400,
    "websocket": 600,
    "http": 600,
    "handle": 300,
    "plasma": 300,
}
MIB = 2**20
ROUNDS = 4
# Resources that may remain.
MOST = {"descriptors": 2, "threads": 2, "maps": 1, "own descriptors": 2, "own threads": 2}


@pytest.mark.own_process
def test_sessions_opened_and_closed_leave_nothing() -> None:
    shared_ray.start()
    with serving("served_agents:Accountant") as server:
        for transport in SESSIONS:
            open_and_close(server, transport)


def open_and_close(server: Server, transport: TransportName) -> None:
    frame = Obs({"front": np.zeros((64, 64, 3), np.uint8)})
    where = (
        f"serve://{next(iter(server.apps))}" if transport in ("handle", "plasma") else server.url
    )

    def session(codec: CodecName = "raw", count: bool = False) -> dict[str, int]:
        with RemoteAgent(where, transport=transport, codec=codec) as agent:
            held = agent.reset(frame, count=count)
            agent.act(frame)
        return held

    number = int(os.environ.get("VLAGENTS_SESSIONS", SESSIONS[transport]))
    # The measurement of the link also takes memory of the server, and the allocator needs time to
    # settle.
    for _ in range(50):
        session("auto")
    for _ in range(number // 10):  # the pools fill up
        session()
    before = session(count=True)
    gc.collect()
    me = psutil.Process()
    mine = me.num_fds(), len(unpooled_threads()), me.memory_info().rss
    resident = [(before["resident"], mine[2])]
    for _ in range(ROUNDS):
        for _ in range(number // ROUNDS):
            session()
        after = session(count=True)
        gc.collect()
        resident.append((after["resident"], me.memory_info().rss))
    grown: dict[str, int] = {}

    def settled() -> bool:
        """Return whether the resources of the last sessions are released. The server's threads
        release them with a delay.
        """
        now = session(count=True)
        grown.update({name: now[name] - before[name] for name in before})
        grown.update(
            {
                "own descriptors": me.num_fds() - mine[0],
                "own threads": len(unpooled_threads()) - mine[1],
            }
        )
        return all(grown[name] <= limit for name, limit in MOST.items())

    with suppress(TimeoutError):
        wait_for(settled)
    print(f"{transport}: {number} sessions: growth {grown}; resident: {resident}")
    assert {name: grown[name] for name, limit in MOST.items() if grown[name] > limit} == {}
    # A leak grows in every round, but an allocator's arena in only one.
    for sizes in zip(*resident, strict=True):
        assert min(b - a for a, b in itertools.pairwise(sizes)) < 4 * MIB / ROUNDS
        assert sizes[-1] - sizes[0] < 4 * 4 * MIB
