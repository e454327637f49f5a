"""Shared memory between a policy and processes on its machine, over an engine without Ray."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for

from vlagents_ray.client.shm import ShmTransport, reaches
from vlagents_ray.errors import (
    ConnectionLost,
    DeadlineExceeded,
    InvalidObservation,
    MalformedMessage,
    PolicyUnavailable,
    UnknownSession,
)
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.local import LocalDoor, peer_uid
from vlagents_ray.wire import compact
from vlagents_ray.wire.frames import encode_request
from vlagents_ray.wire.messages import Limits, LocalAddress, Reply, Request

LIMITS = Limits(body_bytes=4 * 2**20)


class Keeper(Agent):
    """Keeps what it saw, as a policy with history does."""

    gate: threading.Event | None = None

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction, self.seen = instruction, []
        return {}

    def act(self, obs: Obs) -> Act:
        if obs.info.get("wait") and Keeper.gate is not None:
            Keeper.gate.wait(10)
        self.seen.append(obs.cameras["front"])
        action = [float(image[0, 0, 0]) for image in self.seen[-4:]]
        if not obs.info:
            return Act(np.array(action))
        return Act(np.array(action), info={"instruction": self.instruction, "big": bytes(obs.info.get("reply", 0))})


@pytest.fixture
def served() -> Iterator[tuple[Engine, LocalDoor]]:
    engine = Engine(Keeper(), session_limit=50)
    door = LocalDoor(engine, LIMITS)
    door.open()
    engine.start()
    yield engine, door
    engine.close()
    door.close()


def request(op: Any, pixel: int = 0, size: int = 64, **info: Any) -> Request:
    obs = Obs({"front": np.full((size, size, 3), pixel, np.uint8)}, info=info)
    return Request(op, obs, instruction=f"task {pixel}" if op == "reset" else None, request_id=os.urandom(8).hex())


def call(transport: ShmTransport, one: Request, timeout_s: float) -> Reply:
    [reply] = transport.call([one], timeout_s)
    return reply


def client(door: LocalDoor) -> ShmTransport:
    transport = ShmTransport(asdict(door.address))
    transport.connect(5)
    return transport


def test_what_the_policy_keeps_is_not_overwritten(served: tuple[Engine, LocalDoor]) -> None:
    transport = client(served[1])
    call(transport, request("reset"), 5)
    for pixel in range(1, 7):
        act = call(transport, request("act", pixel), 5).act
        assert act is not None
    assert act.action.tolist() == [3, 4, 5, 6]
    transport.close()


def test_memory_that_the_policy_keeps_is_given_back_when_it_lets_go(served: tuple[Engine, LocalDoor]) -> None:
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


def test_vectors_of_sessions_and_odd_observations_come_as_they_are(served: tuple[Engine, LocalDoor]) -> None:
    transport = client(served[1])
    names = [f"env {i}" for i in range(7)]

    def requests(op: Any, step: int) -> list[Request]:
        made = [request(op, 10 * step + i, size=8 + i) for i in range(len(names))]
        for one, name in zip(made, names, strict=True):
            one.session = name
        return made

    assert all(reply.error is None for reply in transport.call(requests("reset", 0), 5))
    for step in (1, 2, 3):
        replies = transport.call(requests("act", step), 5)
        assert [int(reply.act.action[-1]) for reply in replies if reply.act] == [10 * step + i for i in range(7)]
        assert [reply.step for reply in replies] == [step] * 7
    striped = np.zeros((8, 16, 3), np.uint8)
    striped[:, ::2] = 77
    odd = Obs({"front": striped[:, ::2]}, 1.0, {"joints": np.arange(3.0), "none": np.zeros(0, np.float32)})
    [reply] = transport.call([Request("act", odd, session=names[0], request_id="odd", step=3)], 5)
    assert reply.act is not None
    assert reply.act.action.tolist()[-1] == 77
    [reply] = transport.call([Request("act", odd, session=names[0], request_id="odd", step=3)], 5)
    assert isinstance(reply.error, UnknownSession)  # it has four steps behind it
    odd.gripper = 3.0
    [reply] = transport.call([Request("act", odd, session=names[0], request_id="odd")], 5)
    assert isinstance(reply.error, InvalidObservation)
    transport.close()


@pytest.mark.parametrize("op", ["observe", "export", "adopt"])
def test_what_only_a_replica_may_ask_its_child_is_refused(served: tuple[Engine, LocalDoor], op: Any) -> None:
    """Two of these carry pickles."""
    transport = client(served[1])
    call(transport, request("reset"), 5)
    assert isinstance(call(transport, request(op), 5).error, MalformedMessage)
    assert call(transport, request("act"), 5).error is None
    transport.close()


def test_sessions_do_not_mix(served: tuple[Engine, LocalDoor]) -> None:
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
def test_frames_and_replies_of_any_size(served: tuple[Engine, LocalDoor], size: int) -> None:
    transport = client(served[1])
    call(transport, request("reset"), 5)
    for reply in (0, 100_000, 3_000_000):
        act = call(transport, request("act", 9, size, reply=reply), 5).act
        assert act is not None
        assert len(act.info["big"]) == reply
    transport.close()


def test_a_late_reply_is_discarded_and_its_memory_is_not_reused_meanwhile(served: tuple[Engine, LocalDoor]) -> None:
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


def test_a_killed_client_leaves_nothing(served: tuple[Engine, LocalDoor]) -> None:
    engine, door = served
    descriptors = len(os.listdir("/proc/self/fd"))
    code = (
        "import sys, time, numpy as np\n"
        "from vlagents_ray.client.shm import ShmTransport\n"
        "from vlagents_ray import Obs\n"
        "from vlagents_ray.wire.messages import Request\n"
        f"t = ShmTransport({asdict(door.address)!r}); t.connect(5)\n"
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
    wait_for(lambda: len(os.listdir("/proc/self/fd")) <= descriptors)


def test_many_sessions_leave_nothing(served: tuple[Engine, LocalDoor]) -> None:
    def cycle() -> None:
        transport = client(served[1])
        call(transport, request("reset"), 5)
        call(transport, request("act"), 5)
        transport.close()

    cycle()
    wait_for(lambda: len(served[0].sessions) == 0)
    gc.collect()
    before = len(os.listdir("/proc/self/fd")), threading.active_count(), _mapped()
    for _ in range(300):
        cycle()
    wait_for(lambda: len(served[0].sessions) == 0)
    wait_for(lambda: (len(os.listdir("/proc/self/fd")), threading.active_count()) == before[:2])
    assert _mapped() <= before[2]


def _mapped() -> int:
    """Memory files of clients that this process maps."""
    return Path("/proc/self/maps").read_text().count("memfd:vlagents-ray")


def test_a_server_that_is_gone_is_noticed(served: tuple[Engine, LocalDoor]) -> None:
    engine, door = served
    transport = client(door)
    call(transport, request("reset"), 5)
    engine.close()
    door.close()
    begun = time.monotonic()
    with pytest.raises(ConnectionLost):
        call(transport, request("act"), 30)
    assert time.monotonic() - begun < 10
    with pytest.raises(PolicyUnavailable):
        call(transport, request("act"), 5)


def test_a_full_replica_says_so(served: tuple[Engine, LocalDoor]) -> None:
    clients = [client(served[1]) for _ in range(50)]
    for one in clients:
        call(one, request("reset"), 5)
    one_too_many = client(served[1])
    with contextlib.suppress(ConnectionLost):  # it hangs up, maybe before its answer is read
        assert isinstance(call(one_too_many, request("reset"), 5).error, PolicyUnavailable)
    one_too_many.close()
    for one in clients:
        assert call(one, request("act"), 5).error is None
        one.close()


def test_who_leaves_before_hearing_that_the_replica_is_full_keeps_nobody_out(served: tuple[Engine, LocalDoor]) -> None:
    engine, door = served
    engine.sessions.limit = 1
    one, busy = client(door), threading.Event()
    call(one, request("reset"), 5)
    engine.queue.later(lambda: busy.wait(10) and None)  # the door opens when all of them are gone
    for _ in range(3):
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as gone:
            gone.connect(f"\0{door.address.socket}")
    busy.set()
    assert call(one, request("act"), 5).error is None
    one.close()
    wait_for(lambda: not door._clients)
    with contextlib.closing(client(door)) as other:
        assert call(other, request("reset"), 5).error is None


@pytest.mark.parametrize("message", [bytes(LocalAddress.REQUEST.size), b""])
def test_descriptors_that_a_message_brings_are_all_closed(served: tuple[Engine, LocalDoor], message: bytes) -> None:
    before = len(os.listdir("/proc/self/fd"))
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as odd, open(os.devnull) as file:
        odd.settimeout(5)
        odd.connect(f"\0{served[1].address.socket}")
        socket.send_fds(odd, [message], [file.fileno()] * 2)
        odd.recv(1000)  # an error, or the end
    wait_for(lambda: not served[1]._clients)
    assert len(os.listdir("/proc/self/fd")) == before


def test_faults_are_answered_and_harm_nobody(served: tuple[Engine, LocalDoor]) -> None:
    good = client(served[1])
    call(good, request("reset"), 5)

    def pack(number: int, length: int, flags: int = 0) -> bytes:
        return LocalAddress.REQUEST.pack(number, flags, length)

    act = compact.Writer().write([request("act")])
    assert act is not None
    frame = encode_request(request("act"))

    def memory(data: bytes, sealed: bool = True) -> int:
        descriptor = os.memfd_create("test", os.MFD_ALLOW_SEALING)
        os.write(descriptor, data)
        if sealed:
            fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        return descriptor

    def pipe() -> int:
        read, write = os.pipe()
        os.close(write)
        return read

    faults: list[tuple[bytes, int | None, str]] = [
        (b"x", None, "malformed"),
        (pack(0, 10), None, "malformed"),  # no such memory
        (pack(0, 2**40), memory(frame), "malformed"),  # longer than the memory
        (pack(0, len(frame)), memory(frame, sealed=False), "malformed"),
        (pack(0, 10), memory(b"garbage..."), "malformed"),
        (pack(0, 10), pipe(), "malformed"),
        (pack(0, 10), memory(bytes(2 * LIMITS.body_bytes + 1)), "too_large"),
        (pack(99, len(frame)), memory(frame), "too_large"),
        (pack(0, len(frame)), memory(frame), "not_reset"),
        (pack(0, 64, LocalAddress.COMPACT), memory(bytes(64)), "malformed"),
        (pack(0, 64, LocalAddress.COMPACT) + act.message, memory(bytes(64)), "malformed"),  # its arrays need more
        (pack(0, act.size, LocalAddress.COMPACT) + act.message, memory(bytes(act.size)), "not_reset"),
    ]
    for message, descriptor, code in faults:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as bad:
            bad.settimeout(5)
            bad.connect(f"\0{served[1].address.socket}")
            if descriptor is None:
                bad.send(message)
            else:
                socket.send_fds(bad, [message], [descriptor])
                os.close(descriptor)
            answer = bad.recv(2**16)
            assert f'"code":"{code}"'.encode() in answer, (message, answer)
        assert call(good, request("act"), 5).error is None
    good.close()


def test_a_client_that_reads_no_replies_is_cut_off(served: tuple[Engine, LocalDoor]) -> None:
    frame = encode_request(request("act"))
    descriptor = os.memfd_create("test", os.MFD_ALLOW_SEALING)
    os.write(descriptor, frame)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as deaf:
        deaf.settimeout(10)
        deaf.connect(f"\0{served[1].address.socket}")
        socket.send_fds(deaf, [LocalAddress.REQUEST.pack(0, 0, len(frame))], [descriptor])

        def send_many() -> None:
            for _ in range(100_000):
                deaf.send(LocalAddress.REQUEST.pack(0, 0, len(frame)))

        with pytest.raises((BrokenPipeError, ConnectionResetError)):
            send_many()
    os.close(descriptor)
    wait_for(lambda: len(served[0].sessions) == 0)


def test_only_this_machine_is_reached_and_only_the_same_user_let_in(served: tuple[Engine, LocalDoor]) -> None:
    local = asdict(served[1].address)
    assert reaches(local)
    assert not reaches(local | {"boot_id": "another machine"})
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    assert peer_uid(ours) == os.getuid()
    ours.close()
    theirs.close()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
def test_another_user_is_not_let_in(served: tuple[Engine, LocalDoor]) -> None:
    code = (
        "import os, socket, sys\n"
        "os.setuid(65534)\n"
        "s = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET); s.settimeout(5)\n"
        f"s.connect('\\0{served[1].address.socket}')\n"
        "print(s.recv(10))\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True)
    assert result.stdout.strip() == "b''"
    assert len(served[0].sessions) == 0


def test_what_could_not_be_sent_keeps_no_memory() -> None:
    """A server that reads nothing: once its socket is full, calls fail and take nothing more."""
    name = f"vlagents-ray-test-{os.urandom(8).hex()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as deaf:
        deaf.bind(f"\0{name}")
        deaf.listen(1)
        transport = ShmTransport({"socket": name, "boot_id": ""})
        busy = [-1, 0]
        while busy[-1] > busy[-2]:  # sent, and given up
            with pytest.raises(DeadlineExceeded):
                call(transport, request("act", size=8), 0.001)
            busy.append(sum(memory.busy for memory in transport._memories))
        assert busy[-1] > 1
        for _ in range(3):
            with pytest.raises(DeadlineExceeded):
                call(transport, request("act", size=8), 0.001)
        assert sum(memory.busy for memory in transport._memories) == busy[-1]
        assert len(transport._memories) <= busy[-1] + 1
        transport.close()
