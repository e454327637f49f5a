"""Shared memory between a policy and processes on its machine: sessions, clients that end, faults,
and clients without access.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import itertools
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from api_key_replica import plasma_server
from eval_fakes import wait_for
from open_resources import descriptors, running_threads
from shm_client import LIMITS, Keeper, call, client, request

from vlagents_ray.client.transports.shm import ShmTransport, reaches
from vlagents_ray.errors import (
    ConnectionLost,
    DeadlineExceeded,
    InvalidObservation,
    PolicyUnavailable,
    Unauthorized,
    UnknownSession,
)
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol import compact
from vlagents_ray.protocol.frames import encode_requests
from vlagents_ray.protocol.messages import LocalAddress, Request, peer_uid
from vlagents_ray.serve.access.api_keys import Caller, NoKey
from vlagents_ray.serve.access.charges import REFUSALS
from vlagents_ray.serve.endpoints.plasma import PlasmaServer, Pool
from vlagents_ray.serve.endpoints.shm import ShmServer, UnixServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings


@pytest.fixture
def served() -> Iterator[tuple[Engine, ShmServer]]:
    engine = Engine(Keeper(), EngineSettings(session_limit=50))
    endpoint = ShmServer(engine, LIMITS, NoKey.OPEN)
    endpoint.open()
    engine.start()
    yield engine, endpoint
    engine.close()
    endpoint.close()


def test_memory_that_the_policy_keeps_is_given_back_when_it_lets_go(
    served: tuple[Engine, ShmServer],
) -> None:
    """The policy has a window of four frames. It keeps four memory files, and no frame is
    copied.
    """
    transport = client(served[1])
    call(transport, request("reset"), 5)
    for pixel in range(1, 200):
        act = call(transport, request("act", pixel % 250), 5).act
        assert act.action.tolist() == [p % 250 for p in range(max(1, pixel - 3), pixel + 1)]
    assert len(transport._memories) <= 16
    call(transport, request("reset"), 5)  # the policy drops all kept frames
    for pixel in (1, 2, 3):
        call(transport, request("act", pixel), 5)
    assert sum(memory.busy for memory in transport._memories) <= 4
    transport.close()


def test_vectors_of_sessions_and_odd_observations_come_as_they_are(
    served: tuple[Engine, ShmServer],
) -> None:
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
        assert [int(reply.act.action[-1]) for reply in replies if reply.act] == [
            10 * step + i for i in range(7)
        ]
        assert [reply.step for reply in replies] == [begun + step for begun in first]
    striped = np.zeros((8, 16, 3), np.uint8)
    striped[:, ::2] = 77
    odd = Obs(
        {"front": striped[:, ::2]}, 1.0, {"joints": np.arange(3.0), "none": np.zeros(0, np.float32)}
    )
    [reply] = transport.call(
        [Request("act", odd, session=names[0], request_id="odd", step=first[0] + 3)], 5
    )
    assert reply.act.action.tolist()[-1] == 77
    # The session has acted four times; a client may also give the step as this count.
    for step in (first[0] + 3, 3, first[0] - 1):
        [reply] = transport.call(
            [Request("act", odd, session=names[0], request_id="odd", step=step)], 5
        )
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
            assert act.info["instruction"] == f"task {pixel}"
            assert set(act.action.tolist()) == {pixel}
    clients[0].close()
    wait_for(lambda: len(served[0].sessions) == 4)
    assert call(clients[1], request("act", 1), 5).error is None
    for one in clients:
        one.close()


def test_frames_and_replies_of_any_size(served: tuple[Engine, ShmServer]) -> None:
    transport = client(served[1])
    call(transport, request("reset"), 5)
    for size, reply in itertools.product((8, 256, 700, 1100), (0, 100_000, 3_000_000)):
        act = call(transport, request("act", 9, size, reply=reply), 5).act
        assert len(act.info["big"]) == reply
    transport.close()


def test_a_late_reply_is_discarded_and_its_memory_is_not_reused_meanwhile(
    served: tuple[Engine, ShmServer],
) -> None:
    Keeper.gate = threading.Event()
    transport = client(served[1])
    call(transport, request("reset"), 5)
    with pytest.raises(DeadlineExceeded):
        call(transport, request("act", 7, wait=True), 0.05)
    Keeper.gate.set()
    act = call(transport, request("act", 8), 5).act
    assert act.action.tolist() == [7, 8]
    transport.close()


@pytest.mark.slow
@pytest.mark.own_process
def test_neither_descriptors_in_a_message_nor_a_killed_client_leave_anything(
    served: tuple[Engine, ShmServer],
) -> None:
    engine, endpoint = served
    before = descriptors()
    for message in (bytes(LocalAddress.REQUEST.size), b""):
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as odd, open(os.devnull) as file:
            odd.settimeout(5)
            odd.connect(f"\0{endpoint.address.socket}")
            socket.send_fds(odd, [message], [file.fileno()] * 2)
            odd.recv(1000)  # an error, or the end of the connection
        wait_for(lambda: not endpoint._clients and not descriptors() - before)
    code = (
        "import sys, time, numpy as np\n"
        "from vlagents_ray.client.transports.shm import ShmTransport\n"
        "from vlagents_ray import Obs\n"
        "from vlagents_ray.protocol.messages import LocalAddress, Request\n"
        f"t = ShmTransport({endpoint.address!r}); t.connect(5)\n"
        "obs = Obs({'front': np.zeros((64, 64, 3), np.uint8)})\n"
        "t.call([Request('reset', obs, request_id='a')], 5)\n"
        "print('ready', flush=True)\n"
        "while True: t.call([Request('act', obs, request_id='b')], 5)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as process:
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
    with contextlib.suppress(TimeoutError):  # the assertions below report the remaining resources
        wait_for(lambda: not descriptors() - files and not _new(running) and _mapped() <= mapped)
    assert not descriptors() - files
    assert not _new(running)
    assert _mapped() <= mapped


def _new(running: set[threading.Thread]) -> list[str]:
    """Return the names of new threads, except the helper threads of a batch queue. A batch that a
    busy machine delays starts these, and they end with the queue.
    """
    return [one.name for one in running_threads() - running if not one.name.startswith("policy-")]


def _mapped() -> int:
    """Return the number of clients' memory files that this process maps."""
    return Path("/proc/self/maps").read_text().count("memfd:vlagents-ray")


class Gated(Agent):
    """A policy that acts when the gate opens."""

    gate = threading.Event()
    busy = threading.Event()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction = instruction
        return {}

    def act(self, obs: Obs) -> Act:
        Gated.busy.set()
        Gated.gate.wait(60)
        return Act(np.zeros(1), info={"instruction": self.instruction})


def test_a_client_that_ends_while_its_batch_runs_harms_nobody() -> None:
    engine = Engine(Gated())
    endpoint = ShmServer(engine, LIMITS, NoKey.OPEN)
    endpoint.open()
    engine.start()
    one, other = (ShmTransport(endpoint.address) for _ in range(2))
    for each, name in ((one, "first"), (other, "second")):
        call(each, Request("reset", Obs({}), name, request_id=name), 60)
    # The queue polls during a batch only after one slow batch, and if the batch before belonged to
    # another session.
    for ending in (False, False, True):
        asking = one if ending else other
        Gated.gate, Gated.busy = threading.Event(), threading.Event()
        thread = threading.Thread(target=_act_to_the_end, args=(asking,))
        thread.start()
        try:
            assert Gated.busy.wait(60)
            if ending:
                asking._socket.shutdown(socket.SHUT_RDWR)  # type: ignore[union-attr]
                wait_for(lambda: len(engine.sessions) == 1, 50)  # while the batch is running
            else:
                time.sleep(0.02)
        finally:
            Gated.gate.set()
            thread.join(60)
    act = call(other, Request("act", Obs({}), request_id="last"), 60).act
    assert act.info.pop("policy")["version"] == 0
    assert act.info == {"instruction": "second"}
    one.close()
    other.close()
    engine.close()
    endpoint.close()


def _act_to_the_end(transport: ShmTransport) -> None:
    with contextlib.suppress(ConnectionLost):
        call(transport, Request("act", Obs({}), request_id="act"), 60)


def test_a_server_that_is_gone_is_noticed(served: tuple[Engine, ShmServer]) -> None:
    engine, endpoint = served
    transport = client(endpoint)
    call(transport, request("reset"), 5)
    engine.close()
    endpoint.close()
    begun = time.monotonic()
    with pytest.raises(ConnectionLost):
        call(transport, request("act"), 30)
    assert time.monotonic() - begun < 10
    with pytest.raises(PolicyUnavailable):
        call(transport, request("act"), 5)


def test_who_leaves_before_hearing_that_the_replica_is_full_keeps_nobody_out(
    served: tuple[Engine, ShmServer],
) -> None:
    engine, endpoint = served
    engine.sessions.limit = 1
    one, busy = client(endpoint), threading.Event()
    call(one, request("reset"), 5)
    # The poller handles these clients only after all of them have left.
    engine.queue.poller.call_soon(lambda: busy.wait(10) and None)
    for _ in range(3):
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as gone:
            gone.connect(f"\0{endpoint.address.socket}")
    busy.set()
    assert call(one, request("act"), 5).error is None
    one.close()
    wait_for(lambda: not endpoint._clients)
    with contextlib.closing(client(endpoint)) as other:
        assert call(other, request("reset"), 5).error is None


def test_faults_are_answered_and_harm_nobody(served: tuple[Engine, ShmServer]) -> None:
    good = client(served[1])
    call(good, request("reset"), 5)

    def pack(number: int, length: int, flags: int = 0) -> bytes:
        return LocalAddress.REQUEST.pack(number, flags, length)

    act = compact.CompactWriter().write([request("act")])
    assert act is not None
    frame = encode_requests([request("act")])

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
        (pack(0, 10), None, "malformed"),  # there is no such memory file
        (pack(0, 2**40), memory(frame), "malformed"),  # longer than the memory file
        (pack(0, len(frame)), memory(frame, sealed=False), "malformed"),
        (pack(0, 10), memory(b"garbage..."), "malformed"),
        (pack(0, 10), pipe(), "malformed"),
        (pack(0, 10), memory(bytes(2 * LIMITS.body_bytes + 1)), "too_large"),
        (pack(99, len(frame)), memory(frame), "too_large"),
        (pack(0, len(frame)), memory(frame), "not_reset"),
        (pack(0, 64, LocalAddress.COMPACT), memory(bytes(64)), "malformed"),
        # The arrays need more memory than the file has.
        (pack(0, 64, LocalAddress.COMPACT) + act.message, memory(bytes(64)), "malformed"),
        (
            pack(0, act.size, LocalAddress.COMPACT) + act.message,
            memory(bytes(act.size)),
            "not_reset",
        ),
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


def test_a_client_that_reads_no_replies_is_cut_off(served: tuple[Engine, ShmServer]) -> None:
    frame = encode_requests([request("act")])
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


def test_only_this_machine_is_reached_and_only_the_same_user_let_in(
    served: tuple[Engine, ShmServer],
) -> None:
    local = served[1].address
    assert reaches(local)
    assert not reaches(replace(local, boot_id="another machine"))
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    assert peer_uid(ours) == os.getuid()
    ours.close()
    theirs.close()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
def test_another_user_is_not_let_in(
    served: tuple[Engine, ShmServer], caplog: pytest.LogCaptureFixture
) -> None:
    code = (
        "import os, socket, sys\n"
        "print(os.getpid())\n"
        "os.setuid(65534)\n"
        "s = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET); s.settimeout(5)\n"
        f"s.connect('\\0{served[1].address.socket}')\n"
        "print(s.recv(10))\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True
    )
    pid, answer = result.stdout.split()
    assert answer == "b''"
    assert len(served[0].sessions) == 0
    assert f"rejected the process {pid} of user 65534, since" in caplog.text


def test_what_could_not_be_sent_keeps_no_memory() -> None:
    """The server reads nothing. Once its socket is full, calls fail without occupying further
    memory.
    """
    name = f"vlagents-ray-test-{os.urandom(8).hex()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as deaf:
        deaf.bind(f"\0{name}")
        deaf.listen(1)
        transport = ShmTransport(LocalAddress(name, boot_id=""))
        busy = [0]
        # Each message is sent or is abandoned at its deadline, until no more fit into the socket.
        while len(busy) <= 20 or busy[-1] > busy[-20]:
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


def test_a_client_whose_key_is_refused_is_answered_a_few_times_and_then_ended() -> None:
    """Otherwise a process without a key would occupy the policy's thread, which answers each
    message.
    """
    keys: list[str | None] = []

    def refuse(key: str | None) -> Caller:
        keys.append(key)
        raise Unauthorized("an unknown key")

    engine = Engine(Keeper())
    endpoint = ShmServer(engine, LIMITS, refuse)
    endpoint.open()
    stranger = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    stranger.connect(f"\0{endpoint.address.socket}")
    for _ in range(50):
        stranger.send(b"wrong")
    engine.start()
    stranger.settimeout(10)
    answers = list(iter(lambda: stranger.recv(10_000), b""))
    stranger.close()
    assert keys == ["wrong"] * REFUSALS
    assert len(answers) == REFUSALS
    wait_for(lambda: not endpoint._clients)
    engine.close()
    endpoint.close()


def _malformed_messages(server: UnixServer, seconds: float) -> tuple[int, socket.socket]:
    """Send malformed messages as fast as the server reads them; return the number of answers, and
    the connection.
    """
    message, address = bytes(200_000), "\0"
    if isinstance(server, ShmServer):
        message = LocalAddress.REQUEST.pack(LocalAddress.FILES + 1, 0, 100)
        address += server.address.socket
    elif isinstance(server, PlasmaServer):
        address = server.plasma.socket
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    connection.connect(address)
    connection.setblocking(False)
    answers, end = 0, time.monotonic() + seconds
    while time.monotonic() < end:
        sent = received = False
        with contextlib.suppress(BlockingIOError):
            sent = connection.send(message) > 0
        with contextlib.suppress(BlockingIOError):
            received = len(connection.recv(4096)) > 0
            answers += received
        if not (sent or received):
            time.sleep(0.001)
    return answers, connection


@pytest.mark.slow
@pytest.mark.parametrize("endpoint", ["shm", "plasma"])
def test_malformed_messages_of_a_client_are_read_at_a_low_rate_and_disturb_no_other_client(
    served: tuple[Engine, ShmServer],
    endpoint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    engine, near = served
    with contextlib.ExitStack() as stack:
        server: UnixServer = near
        if endpoint == "plasma":
            server = plasma_server(engine, LIMITS, monkeypatch, tmp_path)
            monkeypatch.setattr(server.pool, "claim", Pool(LIMITS).claim)
            server.open()
            stack.callback(server.close)
        with ThreadPoolExecutor(1) as executor, contextlib.closing(client(near)) as robot:
            flood = executor.submit(_malformed_messages, server, 1.5)
            call(robot, request("reset"), 5)
            while not flood.done():
                assert call(robot, request("act", 3), 5).act is not None
            answers, connection = flood.result()
        with connection:
            assert 8 <= answers <= 60  # thousands, if each is read
            connection.setblocking(True)
            connection.settimeout(30)
            connection.send(LocalAddress.PING)
            answer = b""
            while answer != LocalAddress.PONG:  # after those of the messages that wait
                answer = connection.recv(4096)
                assert answer, "the connection was ended"


def test_a_flood_of_connections_that_are_not_accepted_does_not_fill_the_log(
    served: tuple[Engine, ShmServer], caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(1000):
        served[1].warn("client %d", number)
    assert [record.getMessage() for record in caplog.records] == [f"client {n}" for n in range(10)]
