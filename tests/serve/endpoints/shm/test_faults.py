"""Shared memory between a policy and processes on its machine: who is let in, what is refused, who is cut off."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import subprocess
import sys
import threading
import time
from dataclasses import asdict
from typing import Any

import pytest
from eval_fakes import wait_for
from process_resources import descriptors
from shm_client import LIMITS, call, client, request

from vlagents_ray.client.transports.shm import ShmTransport, reaches
from vlagents_ray.errors import (
    ConnectionLost,
    DeadlineExceeded,
    MalformedMessage,
    PolicyUnavailable,
)
from vlagents_ray.protocol import shm_layout
from vlagents_ray.protocol.frames import encode_request
from vlagents_ray.protocol.messages import LocalAddress, peer_uid
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.engine import Engine


@pytest.mark.parametrize("op", ["observe", "export", "adopt"])
def test_what_only_a_replica_may_ask_its_child_is_refused(served: tuple[Engine, ShmServer], op: Any) -> None:
    """Two of these carry pickles."""
    transport = client(served[1])
    call(transport, request("reset"), 5)
    assert isinstance(call(transport, request(op), 5).error, MalformedMessage)
    assert call(transport, request("act"), 5).error is None
    transport.close()


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


def test_a_full_replica_says_so(served: tuple[Engine, ShmServer]) -> None:
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


def test_who_leaves_before_hearing_that_the_replica_is_full_keeps_nobody_out(served: tuple[Engine, ShmServer]) -> None:
    engine, endpoint = served
    engine.sessions.limit = 1
    one, busy = client(endpoint), threading.Event()
    call(one, request("reset"), 5)
    engine.queue.poller.call_soon(lambda: busy.wait(10) and None)  # the endpoint opens when all of them are gone
    for _ in range(3):
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as gone:
            gone.connect(f"\0{endpoint.address.socket}")
    busy.set()
    assert call(one, request("act"), 5).error is None
    one.close()
    wait_for(lambda: not endpoint._clients)
    with contextlib.closing(client(endpoint)) as other:
        assert call(other, request("reset"), 5).error is None


@pytest.mark.own_process
@pytest.mark.parametrize("message", [bytes(LocalAddress.REQUEST.size), b""])
def test_descriptors_that_a_message_brings_are_all_closed(served: tuple[Engine, ShmServer], message: bytes) -> None:
    before = descriptors()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as odd, open(os.devnull) as file:
        odd.settimeout(5)
        odd.connect(f"\0{served[1].address.socket}")
        socket.send_fds(odd, [message], [file.fileno()] * 2)
        odd.recv(1000)  # an error, or the end
    wait_for(lambda: not served[1]._clients and not descriptors() - before)


def test_faults_are_answered_and_harm_nobody(served: tuple[Engine, ShmServer]) -> None:
    good = client(served[1])
    call(good, request("reset"), 5)

    def pack(number: int, length: int, flags: int = 0) -> bytes:
        return LocalAddress.REQUEST.pack(number, flags, length)

    act = shm_layout.ShmWriter().write([request("act")])
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


def test_a_client_that_reads_no_replies_is_cut_off(served: tuple[Engine, ShmServer]) -> None:
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


def test_only_this_machine_is_reached_and_only_the_same_user_let_in(served: tuple[Engine, ShmServer]) -> None:
    local = asdict(served[1].address)
    assert reaches(local)
    assert not reaches(local | {"boot_id": "another machine"})
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    assert peer_uid(ours) == os.getuid()
    ours.close()
    theirs.close()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
def test_another_user_is_not_let_in(served: tuple[Engine, ShmServer]) -> None:
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
        busy = [0]
        while len(busy) <= 20 or busy[-1] > busy[-20]:  # sent, or its time was over before, and given up
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
