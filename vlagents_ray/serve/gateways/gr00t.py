"""The door for GR00T's `PolicyClient`: a ZMQ ROUTER, a session for each client, a thread for each that is busy."""

from __future__ import annotations

import contextlib
import logging
import queue
import socket
import threading
import time
from functools import partial
from typing import Any

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.registry import require
from vlagents_ray.serve.gateways.config import GR00TArgs
from vlagents_ray.serve.gateways.door import House, listen
from vlagents_ray.serve.gateways.gr00t_client import WAITING, Client
from vlagents_ray.wire import gr00t
from vlagents_ray.wire.presets import read_mapping

logger = logging.getLogger(__name__)

Envelope = tuple[bytes, ...]  # who sent a message: the connection, and what lies between it and the payload
_ENVELOPE = 8  # parts
_HEARTBEAT_MS = 10_000
_TICK_MS = 1000
_QUIET_S = 30.0  # a client without a session that says nothing is forgotten
_END_S = 3.0


class GR00TDoor:
    """Listens on a socket that is bound already. One thread owns the ROUTER; each client has one of its own."""

    def __init__(self, house: House, args: GR00TArgs, listener: socket.socket) -> None:
        self._house = house
        self.mapping = read_mapping(args.mapping)
        self._listener = listener
        self._clients: dict[Envelope, Client] = {}
        self._answers: queue.SimpleQueue[tuple[Envelope, bytes]] = queue.SimpleQueue()
        self._bell, self._ring = socket.socketpair()
        self._ring.setblocking(False)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gr00t-door", daemon=True)

    def open(self) -> None:
        """Let clients in."""
        require("zmq"), require("msgpack")
        listen(self._listener)
        self._thread.start()

    def alive(self) -> bool:
        """Does it still let clients in?"""
        return self._thread.is_alive()

    def close(self) -> None:
        """Let nobody in any more; sessions end."""
        self._closing.set()
        self._wake()
        if self._thread.ident is not None:
            self._thread.join(_END_S)
        for client in list(self._clients.values()):
            client.end()
        for client in list(self._clients.values()):
            client.join(_END_S)
        self._listener.close()
        self._bell.close()
        self._ring.close()

    def answer(self, envelope: Envelope, message: bytes) -> None:
        """Send a message to a client, from any thread."""
        self._answers.put((envelope, message))
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):  # it rings already, or the door is closed
            self._ring.send(b".")

    def _run(self) -> None:
        zmq = require("zmq")
        context = zmq.Context(io_threads=1)
        router = context.socket(zmq.ROUTER)
        try:
            router.setsockopt(zmq.LINGER, 0)
            router.setsockopt(zmq.MAXMSGSIZE, self._house.limits.body_bytes)
            router.setsockopt(zmq.RCVHWM, WAITING)
            router.setsockopt(zmq.SNDHWM, WAITING)  # what a client does not fetch is dropped, and holds up nobody
            router.setsockopt(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
            router.setsockopt(zmq.HEARTBEAT_TIMEOUT, 3 * _HEARTBEAT_MS)
            router.setsockopt(zmq.HANDSHAKE_IVL, _HEARTBEAT_MS)
            router.setsockopt(zmq.USE_FD, self._listener.fileno())
            host, port = self._listener.getsockname()[:2]
            router.bind(f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}")
            self._listener.detach()  # ZMQ's own now, to be closed with its socket
            poller = zmq.Poller()
            poller.register(router, zmq.POLLIN)
            poller.register(self._bell, zmq.POLLIN)
            while not self._closing.is_set():
                ready = dict(poller.poll(_TICK_MS))
                if self._bell.fileno() in ready:
                    self._bell.recv(4096)
                    self._send(router, zmq)
                if router in ready:
                    self._receive(router, zmq)
                self._forget_quiet()
        except Exception:
            logger.exception("gr00t: the door has failed")
        finally:
            router.close()
            context.destroy(linger=0)

    def _send(self, router: Any, zmq: Any) -> None:
        while True:
            try:
                envelope, message = self._answers.get_nowait()
            except queue.Empty:
                return
            with contextlib.suppress(zmq.ZMQError):  # it is gone, or does not listen
                router.send_multipart([*envelope, message], zmq.NOBLOCK)

    def _receive(self, router: Any, zmq: Any) -> None:
        for _ in range(64):  # before answers have their turn again
            try:
                parts = router.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            except zmq.ZMQError as error:
                logger.info("gr00t: a message was lost: %s", error)
                return
            if not 2 <= len(parts) <= _ENVELOPE:
                continue
            *envelope, payload = parts
            self._take(tuple(envelope), payload)

    def _take(self, envelope: Envelope, payload: bytes) -> None:
        client = self._clients.get(envelope)
        if client is None:
            if len(self._clients) >= self._house.sessions and not self._forget_one():
                full = PolicyUnavailable(f"{len(self._clients)} clients are connected, the limit; try again later")
                self.answer(envelope, gr00t.pack({"error": f"{full.code}: {full}"}))
                return
            client = self._clients[envelope] = Client(self._house, self.mapping, partial(self.answer, envelope))
        if not client.put(payload):
            self.answer(envelope, gr00t.pack({"error": "malformed: wait for the answer before the next request"}))

    def _forget_quiet(self) -> None:
        now = time.monotonic()
        for envelope, client in list(self._clients.items()):
            if client.quiet_s(now) > (self._house.idle_s if client.begun else min(_QUIET_S, self._house.idle_s)):
                client.end()
                del self._clients[envelope]

    def _forget_one(self) -> bool:
        """Make room: of those without a session, the one that has been quiet for the longest."""
        now = time.monotonic()
        idle = [(client.quiet_s(now), envelope) for envelope, client in self._clients.items() if not client.begun]
        quiet_s, envelope = max(idle, default=(0.0, ()))
        if quiet_s <= 0:
            return False
        self._clients.pop(envelope).end()
        return True
