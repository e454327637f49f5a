"""A server without Ray: one replica, or two that know each other, with all of its endpoints and
dialects.

Only this module builds a replica, so the traces also apply to another implementation of it.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from api_key_replica import PlasmaChannel, plasma_server
from asgi_server import served
from dialect_server import METADATA
from eval_fakes import wait_for
from in_flight import answer_to_frame
from in_memory_keys import ChangingKeys
from in_process_replicas import Replicas
from starlette.types import ASGIApp, Receive, Scope, Send

from tests.golden.failing import fail
from tests.golden.lines import (
    CallLine,
    GrpcLine,
    HttpLine,
    Line,
    OwnHttpLine,
    RemoteInferenceLine,
    RpycLine,
    StrangerLine,
    UnixLine,
    WebSocketLine,
    WholeWebSocketLine,
    ZmqLine,
    ZmtpLine,
)
from tests.golden.masks import masked
from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import MessageLimits
from vlagents_ray.registry import dialect_class
from vlagents_ray.serve.access.api_keys import Caller, Keys, NoKey
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects.base import GatewayContext, ReplicaContext, dialect_routes
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware, Shutdown
from vlagents_ray.serve.endpoints.front import FrontMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.pauses import PauseDetector
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.models.loaded_model import PolicySource
from vlagents_ray.serve.ports import free_port, reserve

LIMITS = MessageLimits(
    body_bytes=4096, pixels=8 * 16, state_values=8, requests=4, items=300, text=80
)
STRICT = Contract(
    cameras={"front": CameraSpec(8, 8)},
    state={"joints": StateSpec(2)},
    instruction=True,
    action=ActionSpec(dim=7, gripper_open=1.0, gripper_closed=0.0),
    chunk=2,
    history=3,
)
# For dialects, each of which has different names.
OPEN = Contract(instruction=True, action=STRICT.action, chunk=2)
# For JSON documents, which have no images.
STATE_ONLY = replace(STRICT, cameras={})
CONTRACTS = {"strict": STRICT, "open": OPEN, "state only": STATE_ONLY}
KEY = "vlr_robot"  # the key of the only client that a server with keys accepts
_DRAWN_AT = 10**15  # wall clock in ns, from which the first step of an episode is derived
_GATEWAYS = {
    "gr00t": ZmqLine,
    "lerobot": GrpcLine,
    "lerobot_remote": RemoteInferenceLine,
    "vlagents": RpycLine,
}
# The end of an endpoint's name, if a connection also records the handshake and the heads of frames.
EACH_BYTE = ", each byte"
_EACH_BYTE_OF_GATEWAY = {"gr00t": ZmtpLine}
OWN_HTTP = "own port, http"
STRANGER = "stranger"  # prefix of the names of lines that send no complete message


class Gate:
    """Blocks the policy within an act."""

    def __init__(self) -> None:
        self.acting, self.opened = threading.Event(), threading.Event()


class Policy(Agent):
    """A policy that returns two rows of a pixel, the sum of the state, the gripper, the length of
    the instruction, the number of acts, the summed pixels of the last three observations, and the
    row. `info` or the instruction can request something else.
    """

    def __init__(self, contract: Contract, gate: Gate, checkpoint: str) -> None:
        self._contract, self.gate, self.checkpoint = contract, gate, checkpoint

    @property
    def contract(self) -> Contract:
        return self._contract

    def shared_objects(self) -> list[object]:
        return [self.gate]

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        if instruction == "no reset":
            fail()
        self.instruction, self.acts, self.seen = (
            instruction or "",
            0,
            deque([_pixel(obs)], maxlen=3),
        )
        return {"instruction": instruction, "options": kwargs}

    def observe(self, obs: Obs) -> None:
        self.seen.append(_pixel(obs))

    def act(self, obs: Obs) -> Act:
        asked = obs.info.get("asked", self.instruction)
        if asked == "wait":
            self.gate.acting.set()
            assert self.gate.opened.wait(20), "the gate of the policy was not opened"
        if asked == "fail":
            fail()
        self.observe(obs)
        self.acts += 1
        state = float(sum(part.sum() for part in obs.state.values()))
        row = [
            _pixel(obs),
            state,
            -1.0 if obs.gripper is None else obs.gripper,
            len(self.instruction),
            self.acts,
        ]
        rows = np.array([[*row, sum(self.seen), 0.25], [*row, sum(self.seen), 0.75]], np.float32)
        answers = {
            "one row": Act(rows[0]),
            "done": Act(rows, done=True),
            "wrong action": Act(rows[:, :3]),
            "no info": Act(rows, info={"set": {1, 2}}),
            "large": Act(rows, info={"zeros": bytes(70_000)}),
        }
        return answers.get(asked) or Act(rows, info=obs.info.get("say", {}))


def _pixel(obs: Obs) -> float:
    return float(next(iter(obs.cameras.values()), np.zeros((1, 1, 1)))[-1, -1, -1])


def _wall_clock() -> int:
    """Return the time from which each step is derived, in ns."""
    return _DRAWN_AT


class Server:
    """The server of a scenario. Its settings are `sessions`, `ready`, `replicas`, `keys`, the
    `rate` of its key, the name of a `contract`, and `dialects` by name.
    """

    def __init__(
        self, stack: contextlib.ExitStack, patch: pytest.MonkeyPatch, folder: Path, **settings: Any
    ) -> None:
        self._stack, self._patch, self._folder = stack, patch, folder
        self._dialects: dict[str, Any] = settings.get("dialects", {})
        self._ready = settings.get("ready", True)
        self._contract = CONTRACTS[settings.get("contract", "open" if self._dialects else "strict")]
        self._keys: Keys | None = None
        if settings.get("keys"):
            keys = ChangingKeys()
            limits = {"rate": settings["rate"]} if "rate" in settings else {}
            keys.add(KEY.removeprefix("vlr_"), **limits)
            self._keys = keys.keys
        # A request that waits in a pause of a slow process is sent again, with another step.
        patch.setattr(PauseDetector, "latest", lambda _: 0.0)
        self._shutdown = Shutdown()
        self._websockets = 0  # number of open WebSockets at the HTTP port
        self._gate = Gate()
        self._own: Any = None

        # Resources that are closed when the server stops, in reverse order, or at the end of the
        # scenario.
        self._running = contextlib.ExitStack()
        stack.callback(self._running.close)
        self._running.callback(lambda: self._own and self._own.close())  # closed after the engine

        session_limit = settings.get("sessions", 100)
        policy = PolicySource(self._agent, {"checkpoint": "first"})
        self._replicas: Replicas | None = None
        gateway = self._dialects.keys() & _GATEWAYS.keys()
        if gateway or settings.get("replicas"):
            self._replicas = Replicas(
                [policy for _ in range(settings.get("replicas", 1))],
                wall_clock=_wall_clock,
                session_limit=session_limit,
            )
            self._running.callback(self._replicas.close)
            self.engines = self._replicas.engines
        else:
            engine_settings = EngineSettings(session_limit=session_limit)
            self.engines = [Engine(policy, engine_settings, wall_clock=_wall_clock)]
            self._running.callback(self.engines[0].close)
        self._ports: dict[int, int] = {}  # HTTP ports by replica
        for name in gateway:
            self._open_gateway(name)
        stack.callback(self._gate.opened.set)

    @property
    def keys(self) -> Keys | None:
        """The keys of the server; None without `keys`."""
        return self._keys

    def line(self, endpoint: str, name: str) -> Line:
        """Return a new connection to the replica whose number, counted from 0, is the last digit of
        the name, or to the first replica.
        """
        number = int(name[-1]) if name[-1].isdigit() else 0
        each_byte = endpoint.endswith(EACH_BYTE)
        endpoint = endpoint.removesuffix(EACH_BYTE)
        if endpoint in _GATEWAYS:
            gateway_line = _EACH_BYTE_OF_GATEWAY if each_byte else _GATEWAYS
            line = StrangerLine if name.startswith(STRANGER) else gateway_line[endpoint]
            return line(self._gateway_port)
        if endpoint in ("shared memory", "plasma"):
            return self._unix_line(endpoint)
        if endpoint == "handle":
            self._start()
            return self._handle(self.engines[number], name)

        if endpoint in ("own port", OWN_HTTP):
            own = self._open_own("own port")
            port, path = own.address.port, own.path
        else:
            port, path = self._http(number), endpoint
        if endpoint == OWN_HTTP:
            return OwnHttpLine(port, path)
        if endpoint == "http":
            return HttpLine(port)
        return WholeWebSocketLine(port, path) if each_byte else WebSocketLine(port, path)

    def do(self, what: str) -> None:
        """Apply an event to the server."""
        happens = {
            "drains": self.engines[0].drain_list.drain,
            "stops": self._stop,
            "is acting": lambda: (
                self._gate.acting.wait(20) or pytest.fail("the policy was not called")
            ),
            "acts on": self._gate.opened.set,
            "has no session": lambda: wait_for(lambda: not len(self.engines[0].sessions)),
            "has a request": lambda: wait_for(self._gateway_has_request),
        }
        happens[what]()

    def _stop(self) -> None:
        """Stop like a replica: its WebSockets end first, then the engine, then the endpoints."""
        self._shutdown.begin()
        wait_for(lambda: not self._websockets)
        self._running.close()

    def _gateway_has_request(self) -> bool:
        clients = self._gateway._clients._clients.values()
        return any(client._unanswered for client in clients)

    def _agent(self, settings: Any) -> Policy:
        return Policy(self._contract, self._gate, settings["checkpoint"])

    def _start(self) -> None:
        if self._ready and self._replicas is None and not self.engines[0].health.alive:
            self.engines[0].start()

    def _http(self, number: int) -> int:
        if number not in self._ports:
            self._start()
            engine = self.engines[number]
            metadata = METADATA | {"contract": self._contract.to_json()}
            routes = dialect_routes(
                DialectArgs(**self._dialects), ReplicaContext(engine, lambda: metadata, LIMITS)
            )
            inside = build_http_app(engine, lambda: metadata, LIMITS, more=routes)
            guarded = AccessMiddleware(
                inside,
                self._keys,
                "app",
                admission=engine.admission,
                shutdown=self._shutdown,
            )
            app = FrontMiddleware(self._counting_websockets(guarded))
            self._ports[number] = self._stack.enter_context(served(app))
        return self._ports[number]

    def _counting_websockets(self, app: ASGIApp) -> ASGIApp:
        async def run(scope: Scope, receive: Receive, send: Send) -> None:
            is_websocket = scope["type"] == "websocket"
            self._websockets += is_websocket
            try:
                await app(scope, receive, send)
            finally:
                self._websockets -= is_websocket

        return run

    def _open_own(self, endpoint: str) -> Any:
        """Return the server of the endpoint, which is listening."""
        if self._own is None:
            engine, check_key = self.engines[0], self._check()
            if endpoint == "own port":
                self._own = OwnPortServer(engine, LIMITS, "127.0.0.1", None, check_key)
            elif endpoint == "plasma":
                self._own = plasma_server(engine, LIMITS, self._patch, self._folder)
            else:
                self._own = ShmServer(engine, LIMITS, check_key)
            self._own.open()
            self._start()
        return self._own

    def _unix_line(self, endpoint: str) -> UnixLine:
        own = self._open_own(endpoint)
        if endpoint == "plasma":
            return UnixLine(
                own.plasma.socket,
                lambda message, data: PlasmaChannel.frames.update({message[:28]: data}),
            )
        return UnixLine(f"\0{own.address.socket}")

    def _check(self) -> Callable[[str | None], Caller] | NoKey:
        return NoKey.OPEN if self._keys is None else partial(self._keys.check, app="app")

    def _handle(self, engine: Engine, name: str) -> Line:
        call = partial(answer_to_frame, engine, LIMITS, f"session-{name}")
        return CallLine(lambda data, _: ("binary", masked(call(data))))

    def _open_gateway(self, name: str) -> None:
        assert self._replicas is not None
        replicas, cls, port = self._replicas, dialect_class(name), free_port()
        context = GatewayContext(
            "app",
            lambda _key, priority: replicas.agent(priority=priority or "robot"),
            LIMITS,
            8,
            30.0,
            OPEN,
            self._check(),
        )
        dialect: Any = cls(name, cls.Config(port=port, **self._dialects[name]), context)
        dialect.serve(reserve(name, "127.0.0.1", port))
        self._running.callback(dialect.close)
        self._gateway, self._gateway_port = dialect, port
