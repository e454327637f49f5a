"""One client of GR00T's door: its requests, answered one after the other, and its sessions."""

from __future__ import annotations

import logging
import queue
import threading
import time
import uuid
from collections.abc import Callable, Iterable
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.serve.gateways.door import House
from vlagents_ray.serve.gateways.talk import Talk
from vlagents_ray.wire import gr00t
from vlagents_ray.wire.gr00t import Observations, Request
from vlagents_ray.wire.mapping import KeyMapping
from vlagents_ray.wire.paths import matches

logger = logging.getLogger(__name__)

WAITING = 4  # requests of one client; a REQ socket has one


class Client:
    """One client's requests, answered one after the other on a thread of its own."""

    def __init__(self, house: House, mapping: KeyMapping, answer: Callable[[bytes], None]) -> None:
        self._house = house
        self._mapping = mapping
        self._send = answer
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
            if self._pending >= WAITING:
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
            self._send(message)
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
        mapping, contract = self._mapping, self._house.contract
        seen = [mapping.obs(gr00t.newest(one), self._house.limits) for one in asked.each]
        acts = self._talk.act_batch([obs for obs, _ in seen], [text for _, text in seen])
        spec = None if contract is None else contract.action
        info = {"done": [act.done for act in acts]} | {"timing": acts[0].info.get("timing", {})}
        return gr00t.write_actions([mapping.actions(act.action, spec) for act in acts], asked, info)

    def _modalities(self) -> dict[str, tuple[list[str], list[int]]]:
        mapping, contract = self._mapping, self._house.contract
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


def _theirs(entries: Iterable[tuple[str, str]], needed: Iterable[str]) -> list[str]:
    """What a client calls the policy's cameras or states: as in the mapping, in which `*` keeps our names."""
    found: dict[str, None] = {}
    for ours, key in entries:
        names = needed if "*" in key else [key.rpartition("/")[2]]
        found |= dict.fromkeys(name for name in names if "*" not in key or matches(name, ours))
    return list(found)
