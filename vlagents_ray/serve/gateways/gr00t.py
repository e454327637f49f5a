"""The door for GR00T's `PolicyClient`: a ZMQ ROUTER, a session for each client, a thread for each that is busy."""

from __future__ import annotations

import contextlib
import logging
import queue
import socket
import threading
import time
import uuid
from collections.abc import Iterable
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.errors import PolicyUnavailable, VLAgentsError
from vlagents_ray.registry import require
from vlagents_ray.serve.gateways.config import GR00TArgs
from vlagents_ray.serve.gateways.door import House, listen
from vlagents_ray.serve.gateways.talk import Talk
from vlagents_ray.wire import gr00t
from vlagents_ray.wire.gr00t import Observations, Request
from vlagents_ray.wire.paths import matches
from vlagents_ray.wire.presets import read_mapping

logger = logging.getLogger(__name__)

Envelope = tuple[bytes, ...]  # who sent a message: the connection, and what lies between it and the payload
_ENVELOPE = 8  # parts
_WAITING = 4  # requests of one client; a REQ socket has one
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
        self._clients: dict[Envelope, _Client] = {}
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
            router.setsockopt(zmq.RCVHWM, _WAITING)
            router.setsockopt(zmq.SNDHWM, _WAITING)  # what a client does not fetch is dropped, and holds up nobody
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
            client = self._clients[envelope] = _Client(self, self._house, envelope)
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


def _theirs(entries: Iterable[tuple[str, str]], needed: Iterable[str]) -> list[str]:
    """What a client calls the policy's cameras or states: as in the mapping, in which `*` keeps our names."""
    found: dict[str, None] = {}
    for ours, key in entries:
        names = needed if "*" in key else [key.rpartition("/")[2]]
        found |= dict.fromkeys(name for name in names if "*" not in key or matches(name, ours))
    return list(found)


class _Client:
    """One client's requests, answered one after the other on a thread of its own."""

    def __init__(self, door: GR00TDoor, house: House, envelope: Envelope) -> None:
        self._door = door
        self._house = house
        self._envelope = envelope
        self._talk = Talk(house.connect)
        self._requests: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._pending = 0  # requests without an answer
        self._lock = threading.Lock()
        self._used = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="gr00t-client", daemon=True)
        self._thread.start()

    @property
    def begun(self) -> bool:
        """Does it hold a session?"""
        return self._talk.begun

    def put(self, payload: bytes) -> bool:
        """Queue a request; False if there are too many."""
        with self._lock:
            if self._pending >= _WAITING:
                return False
            self._pending += 1
        self._requests.put(payload)
        return True

    def quiet_s(self, now: float) -> float:
        """How long it has said nothing; 0 while it waits for an answer."""
        return 0.0 if self._pending else now - self._used

    def end(self) -> None:
        """End its session, after the request under way."""
        self._requests.put(None)

    def join(self, timeout_s: float) -> None:
        """Wait for that."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (payload := self._requests.get()) is not None:
            message = self._answer(payload)
            with self._lock:
                self._pending -= 1
                self._used = time.monotonic()
            self._door.answer(self._envelope, message)
        self._talk.close()

    def _answer(self, payload: bytes) -> bytes:
        try:
            request = gr00t.read_request(payload, self._house.limits)
            if self._house.check is not None:
                self._house.check(request.api_token)
                self._talk.show(request.api_token)
            return gr00t.pack(self._value(request), packed=request.packed)
        except VLAgentsError as error:
            return gr00t.pack({"error": f"{error.code}: {error}"})
        except Exception:
            name = uuid.uuid4().hex
            logger.exception("gr00t: request %s failed", name)
            return gr00t.pack({"error": f"internal error; the server's log has the details under {name}"})

    def _value(self, request: Request) -> Any:
        if request.endpoint == "ping":
            return {"status": "ok", "message": "Server is running"}
        if request.endpoint == "get_modality_config":
            return gr00t.modality_config(self._modalities())
        if request.endpoint == "reset":
            self._talk.restart()
            return {}
        return self._act(gr00t.read_observations(request.data))

    def _act(self, asked: Observations) -> Any:
        mapping, contract = self._door.mapping, self._house.contract
        seen = [mapping.obs(gr00t.newest(one), self._house.limits) for one in asked.each]
        acts = self._talk.act_batch([obs for obs, _ in seen], [text for _, text in seen])
        spec = None if contract is None else contract.action
        info = {"done": [act.done for act in acts]} | {"timing": acts[0].info.get("timing", {})}
        return gr00t.write_actions([mapping.actions(act.action, spec) for act in acts], asked, info)

    def _modalities(self) -> dict[str, tuple[list[str], list[int]]]:
        mapping, contract = self._door.mapping, self._house.contract
        contract = contract or Contract()
        cameras = [(name, camera.key) for name, camera in mapping.cameras.items()]
        state = [(name, part.key) for name, parts in mapping.state.items() for part in parts]
        chunk = contract.chunk or 1
        return {
            "video": (_theirs(cameras, contract.cameras or {}), [0]),
            "state": (_theirs(state, contract.state or {}), [0]),
            "action": (list(mapping.action) or ["action"], list(range(chunk))),
            "language": ([gr00t.TEXT_KEY], [0]),
        }
