"""Shared memory between a policy and processes on its machine: what is said in it, and what becomes of it."""

from __future__ import annotations

import contextlib
import gc
import signal
import subprocess
import sys
import threading
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from process_resources import descriptors, running_threads
from shm_client import Keeper, call, client, request

from vlagents_ray.errors import (
    DeadlineExceeded,
    InvalidObservation,
    UnknownSession,
)
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.engine import Engine


def test_what_the_policy_keeps_is_not_overwritten(served: tuple[Engine, ShmServer]) -> None:
    transport = client(served[1])
    call(transport, request("reset"), 5)
    for pixel in range(1, 7):
        act = call(transport, request("act", pixel), 5).act
        assert act is not None
    assert act.action.tolist() == [3, 4, 5, 6]
    transport.close()


def test_memory_that_the_policy_keeps_is_given_back_when_it_lets_go(served: tuple[Engine, ShmServer]) -> None:
    """A window of four frames: four files stay with the policy, and no frame is ever copied for it."""
    transport = client(served[1])
    call(transport, request("reset"), 5)
    for pixel in range(1, 200):
        act = call(transport, request("act", pixel % 250), 5).act
        assert act is not None
        assert act.action.tolist() == [p % 250 for p in range(max(1, pixel - 3), pixel + 1)]
    assert len(transport._memories) <= 16
    call(transport, request("reset"), 5)  # all that it kept goes
    for pixel in (1, 2, 3):
        call(transport, request("act", pixel), 5)
    assert sum(memory.busy for memory in transport._memories) <= 4
    transport.close()


def test_vectors_of_sessions_and_odd_observations_come_as_they_are(served: tuple[Engine, ShmServer]) -> None:
    transport = client(served[1])
    names = [f"env-{i}" for i in range(7)]

    def requests(op: Any, step: int) -> list[Request]:
        made = [request(op, 10 * step + i, size=8 + i) for i in range(len(names))]
        for one, name in zip(made, names, strict=True):
            one.session = name
        return made

    first = [reply.step or 0 for reply in transport.call(requests("reset", 0), 5)]
    assert all(first)
    for step in (1, 2, 3):
        replies = transport.call(requests("act", step), 5)
        assert [int(reply.act.action[-1]) for reply in replies if reply.act] == [10 * step + i for i in range(7)]
        assert [reply.step for reply in replies] == [begun + step for begun in first]
    striped = np.zeros((8, 16, 3), np.uint8)
    striped[:, ::2] = 77
    odd = Obs({"front": striped[:, ::2]}, 1.0, {"joints": np.arange(3.0), "none": np.zeros(0, np.float32)})
    [reply] = transport.call([Request("act", odd, session=names[0], request_id="odd", step=first[0] + 3)], 5)
    assert reply.act is not None
    assert reply.act.action.tolist()[-1] == 77
    for step in (first[0] + 3, 3, first[0] - 1):  # it has four acts behind it, and may be called by that count
        [reply] = transport.call([Request("act", odd, session=names[0], request_id="odd", step=step)], 5)
        assert isinstance(reply.error, UnknownSession)
    odd.gripper = 3.0
    [reply] = transport.call([Request("act", odd, session=names[0], request_id="odd")], 5)
    assert isinstance(reply.error, InvalidObservation)
    transport.close()


def test_sessions_do_not_mix(served: tuple[Engine, ShmServer]) -> None:
    clients = [client(served[1]) for _ in range(5)]
    for pixel, one in enumerate(clients):
        call(one, request("reset", pixel), 5)
    for _ in range(50):
        for pixel, one in enumerate(clients):
            act = call(one, request("act", pixel, tell=1), 5).act
            assert act is not None
            assert act.info["instruction"] == f"task {pixel}"
            assert set(act.action.tolist()) == {pixel}
    clients[0].close()
    wait_for(lambda: len(served[0].sessions) == 4)
    assert call(clients[1], request("act", 1), 5).error is None
    for one in clients:
        one.close()


@pytest.mark.parametrize("size", [8, 256, 700, 1100])
def test_frames_and_replies_of_any_size(served: tuple[Engine, ShmServer], size: int) -> None:
    transport = client(served[1])
    call(transport, request("reset"), 5)
    for reply in (0, 100_000, 3_000_000):
        act = call(transport, request("act", 9, size, reply=reply), 5).act
        assert act is not None
        assert len(act.info["big"]) == reply
    transport.close()


def test_a_late_reply_is_discarded_and_its_memory_is_not_reused_meanwhile(served: tuple[Engine, ShmServer]) -> None:
    Keeper.gate = threading.Event()
    transport = client(served[1])
    call(transport, request("reset"), 5)
    with pytest.raises(DeadlineExceeded):
        call(transport, request("act", 7, wait=True), 0.05)
    Keeper.gate.set()
    act = call(transport, request("act", 8), 5).act
    assert act is not None
    assert act.action.tolist() == [7, 8]
    transport.close()


@pytest.mark.own_process
def test_a_killed_client_leaves_nothing(served: tuple[Engine, ShmServer]) -> None:
    engine, endpoint = served
    before = descriptors()
    code = (
        "import sys, time, numpy as np\n"
        "from vlagents_ray.client.transports.shm import ShmTransport\n"
        "from vlagents_ray import Obs\n"
        "from vlagents_ray.protocol.messages import Request\n"
        f"t = ShmTransport({asdict(endpoint.address)!r}); t.connect(5)\n"
        "obs = Obs({'front': np.zeros((64, 64, 3), np.uint8)})\n"
        "t.call([Request('reset', obs, request_id='a')], 5)\n"
        "print('ready', flush=True)\n"
        "while True: t.call([Request('act', obs, request_id='b')], 5)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == "ready"
        assert len(engine.sessions) == 1
        process.send_signal(signal.SIGKILL)
    wait_for(lambda: len(engine.sessions) == 0)
    wait_for(lambda: not descriptors() - before)


@pytest.mark.own_process
def test_many_sessions_leave_nothing(served: tuple[Engine, ShmServer]) -> None:
    def cycle() -> None:
        transport = client(served[1])
        call(transport, request("reset"), 5)
        call(transport, request("act"), 5)
        transport.close()

    cycle()
    wait_for(lambda: len(served[0].sessions) == 0)
    gc.collect()
    files, running, mapped = descriptors(), running_threads(), _mapped()
    for _ in range(300):
        cycle()
    wait_for(lambda: len(served[0].sessions) == 0)
    with contextlib.suppress(TimeoutError):  # what is left then is said below
        wait_for(lambda: not descriptors() - files and not _new(running) and _mapped() <= mapped)
    assert not descriptors() - files
    assert not _new(running)
    assert _mapped() <= mapped


def _new(running: set[threading.Thread]) -> list[str]:
    """Threads beside those, but for the helpers of a batch queue: the first batch that a busy machine delays starts
    them, and they end with it."""
    return [one.name for one in running_threads() - running if not one.name.startswith("policy-")]


def _mapped() -> int:
    """Memory files of clients that this process maps."""
    return Path("/proc/self/maps").read_text().count("memfd:vlagents-ray")
