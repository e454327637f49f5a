"""The connection of one GR00T client: its requests, which are processed one after the other, and its sessions."""

from __future__ import annotations

import logging
import queue
import re
import threading
import time
import uuid
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.dialects.base import GatewayContext
from vlagents_ray.serve.dialects.gateway_sessions import GatewaySessions
from vlagents_ray.wire import gr00t
from vlagents_ray.wire.gr00t import GR00TRequest, Observations
from vlagents_ray.wire.mapping import KeyMapping, matches

logger = logging.getLogger(__name__)

_FOLDER = re.compile(r"^(video|state|language)\.")
WAITING = 4  # maximum of waiting requests of one client; a REQ socket sends one at a time


class GR00TConnection:
    """One client's requests, which are processed one after the other on a separate thread."""

    def __init__(self, context: GatewayContext, mapping: KeyMapping, answer: Callable[[bytes], None]) -> None:
        self._context = context
        self._mapping, self._flat = nested_mapping(mapping)  # flat: whether the client's last keys were N1.5's
        self._send = answer
        self._session = GatewaySessions(context.connect, context.contract)
        self._requests: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._pending = 0  # number of requests without a reply
        self._lock = threading.Lock()
        self._used = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="gr00t-client", daemon=True)
        self._thread.start()

    @property
    def known(self) -> bool:
        """Whether the client has shown a valid key, or needs none."""
        return self._session.known

    @property
    def begun(self) -> bool:
        """Whether the client has a session."""
        return self._session.begun

    def put(self, payload: bytes) -> bool:
        """Queue a request; return False if too many are waiting.

        Raises `Overloaded` if the requests of all clients leave no memory for it.
        """
        with self._lock:
            if self._pending >= WAITING:
                return False
            self._context.admission.hold(len(payload), True, 0)
            self._pending += 1
        self._requests.put(payload)
        return True

    def refusal(self) -> str | None:
        """Return the reason if the client's key is no longer valid; None if it is valid or there is none."""
        return self._session.refusal()

    def quiet_s(self, now: float) -> float:
        """Return the time since the client's last request, s; 0 while it waits for a reply."""
        return 0.0 if self._pending else now - self._used

    def end(self) -> None:
        """End the client's sessions, after the current request."""
        self._requests.put(None)

    def join(self, timeout_s: float) -> None:
        """Wait until the thread has ended."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (payload := self._requests.get()) is not None:
            message = self._answer(payload)
            self._context.admission.release(len(payload))
            with self._lock:
                self._pending -= 1
                self._used = time.monotonic()
            self._send(message)
            time.sleep(self._session.throttled_s())
        self._session.close()

    def _answer(self, payload: bytes) -> bytes:
        try:
            self._let_in(payload)
            self._session.begin()
            request = gr00t.read_request(payload, self._context.limits)
            return gr00t.pack(self._value(request), packed=request.packed)
        except VLAgentsError as error:
            return gr00t.pack({"error": f"{error.code}: {error}"})
        except Exception:
            name = uuid.uuid4().hex
            logger.exception("gr00t: request %s failed", name)
            return gr00t.pack({"error": f"internal error; the server's log has the details under {name}"})

    def _let_in(self, payload: bytes) -> None:
        """Identify the client by the key in the message, before anything else of that is decoded."""
        check = self._context.check
        if isinstance(check, NoKey):
            self._session.show(check, None)
        else:
            key = gr00t.read_token(payload, self._context.limits)
            self._session.show(check(key), key)

    def _value(self, request: GR00TRequest) -> Any:
        if request.endpoint == "ping":
            return {"status": "ok", "message": "Server is running"}
        if request.endpoint == "get_modality_config":
            return gr00t.modality_config(self._modalities(), flat=self._flat)
        if request.endpoint == "reset":
            self._session.restart()
            return {}
        return self._act(gr00t.read_observations(request.data))

    def _act(self, asked: Observations) -> Any:
        mapping, contract = self._mapping, self._context.contract
        self._flat = asked.flat
        seen = [mapping.obs(gr00t.newest(one), self._context.limits, contract) for one in asked.each]
        if not self._session.begun:
            mapping.warn_of_unread_cameras(gr00t.newest(asked.each[0]), "gr00t")
        acts = self._session.act_batch([obs for obs, _ in seen], [text for _, text in seen])
        spec = None if contract is None else contract.action
        info = {"done": [act.done for act in acts]} | {"timing": acts[0].info.get("timing", {})}
        return gr00t.write_actions([mapping.actions(act.action, spec) for act in acts], asked, info)

    def _modalities(self) -> dict[str, tuple[list[str], list[int]]]:
        mapping, contract = self._mapping, self._context.contract
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
    """Return the client's names of the policy's cameras or states, from the mapping, in which `*` keeps our names."""
    found: dict[str, None] = {}
    for ours, key in entries:
        names = needed if "*" in key else [key.rpartition("/")[2]]
        found |= dict.fromkeys(name for name in names if "*" not in key or matches(name, ours))
    return list(found)


def nested_mapping(mapping: KeyMapping) -> tuple[KeyMapping, bool]:
    """Return a mapping with the keys of `gr00t.newest`, and whether it had N1.5's flat keys, such as `video.front`."""

    def folders(key: str) -> str:
        return "|".join(_FOLDER.sub(r"\1/", one) for one in key.split("|"))

    nested = replace(
        mapping,
        cameras={name: replace(one, key=folders(one.key)) for name, one in mapping.cameras.items()},
        state={name: tuple(replace(one, key=folders(one.key)) for one in of) for name, of in mapping.state.items()},
        gripper=mapping.gripper and replace(mapping.gripper, key=folders(mapping.gripper.key)),
        instruction=mapping.instruction and f"language/{gr00t.TEXT_KEY}",
        action={name.removeprefix("action."): one for name, one in mapping.action.items()},
    )
    return nested, nested.cameras != mapping.cameras or nested.state != mapping.state
