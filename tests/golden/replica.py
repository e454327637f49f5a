"""A server without Ray: one replica, or two that know each other, with all of its endpoints and
dialects.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import deque
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from api_key_replica import PlasmaChannel, plasma_server
from asgi_server import served
from dialect_server import METADATA
from eval_fakes import wait_for
from in_process_replicas import Replicas

from tests.golden.failing import fail
from tests.golden.lines import (
    CallLine,
    GrpcLine,
    HttpLine,
    Line,
    RpycLine,
    UnixLine,
    WebSocketLine,
    ZmqLine,
)
from tests.golden.masks import masked
from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import MessageLimits
from vlagents_ray.registry import dialect_class
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects.base import GatewayContext, ReplicaContext, dialect_routes
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.endpoints.websocket import WebSocketServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.models.checkpoints import Checkpoints
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
# For dialects, each of which has names of its own.
OPEN = Contract(instruction=True, action=STRICT.action, chunk=2)
_DRAWN_AT = 10**15  # ns, of the wall clock that the first step of an episode is drawn from
_GATEWAYS = {"gr00t": ZmqLine, "lerobot": GrpcLine, "vlagents": RpycLine}


class Gate:
    """Holds the policy within an act."""

    def __init__(self) -> None:
        self.acting, self.opened = threading.Event(), threading.Event()


class Policy(Agent):
    """Acts by what it saw: two rows of a pixel, the sum of the state, the gripper, the length of
    the instruction, the
    acts so far, the pixels of the last three observations together, and the row. `info` or the
    instruction asks for something else."""

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
            self.gate.opened.wait(20)
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
    """The time at which each step is drawn, ns."""
    return _DRAWN_AT


class Server:
    """What a scenario talks to; its settings are `sessions`, `ready`, `replicas`, and `dialects`
    by name.
    """

    def __init__(
        self, stack: contextlib.ExitStack, patch: pytest.MonkeyPatch, folder: Path, **settings: Any
    ) -> None:
        self._stack, self._patch, self._folder = stack, patch, folder
        self._dialects: dict[str, Any] = settings.get("dialects", {})
        self._ready = settings.get("ready", True)
        self._gate = Gate()
        self._own: Any = None
        stack.callback(lambda: self._own and self._own.close())  # after the engine
        session_limit = settings.get("sessions", 100)
        self._offered = partial(
            Checkpoints, self._agent, {"checkpoint": "first"}, {"other": {"checkpoint": "second"}}
        )
        self._replicas: Replicas | None = None
        gateway = self._dialects.keys() & _GATEWAYS.keys()
        if gateway or settings.get("replicas"):
            self._replicas = Replicas(
                [self._offered() for _ in range(settings.get("replicas", 1))],
                wall_clock=_wall_clock,
                session_limit=session_limit,
            )
            stack.callback(self._replicas.close)
            self.engines = self._replicas.engines
        else:
            engine_settings = EngineSettings(session_limit=session_limit)
            self.engines = [Engine(self._offered(), engine_settings, wall_clock=_wall_clock)]
            stack.callback(self.engines[0].close)
        self._ports: dict[int, int] = {}  # of HTTP, by replica
        for name in gateway:
            self._open_gateway(name)
        stack.callback(self._gate.opened.set)

    def line(self, endpoint: str, name: str) -> Line:
        """A new connection to the replica that the name's last digit counts from 0, or to the
        first.
        """
        number = int(name[-1]) if name[-1].isdigit() else 0
        if endpoint in _GATEWAYS:
            return _GATEWAYS[endpoint](self._gateway_port)
        if endpoint in ("own port", "shared memory", "plasma"):
            return self._own_line(endpoint)
        if endpoint == "handle":
            self._start()
            return self._handle(self.engines[number], name)
        port = self._http(number)
        return HttpLine(port) if endpoint == "http" else WebSocketLine(port, endpoint)

    def do(self, what: str) -> None:
        """Something that happens to the server."""
        happens = {
            "drains": self.engines[0].drain_list.drain,
            "is acting": lambda: (
                self._gate.acting.wait(20) or pytest.fail("the policy was not asked")
            ),
            "acts on": self._gate.opened.set,
            "has no session": lambda: wait_for(lambda: not len(self.engines[0].sessions)),
        }
        happens[what]()

    def _agent(self, settings: Any) -> Policy:
        return Policy(OPEN if self._dialects else STRICT, self._gate, settings["checkpoint"])

    def _start(self) -> None:
        if self._ready and self._replicas is None and not self.engines[0].health.alive:
            self.engines[0].start()

    def _http(self, number: int) -> int:
        if number not in self._ports:
            self._start()
            engine = self.engines[number]
            routes = dialect_routes(
                DialectArgs(**self._dialects), ReplicaContext(engine, lambda: METADATA, LIMITS)
            )
            app = build_http_app(engine, lambda: METADATA, LIMITS, more=routes)
            self._ports[number] = self._stack.enter_context(
                served(AccessMiddleware(app, None, "app"))
            )
        return self._ports[number]

    def _own_line(self, endpoint: str) -> Line:
        engine = self.engines[0]
        if self._own is None:
            if endpoint == "own port":
                self._own = WebSocketServer(engine, LIMITS, "127.0.0.1", None, NoKey.OPEN)
            elif endpoint == "plasma":
                self._own = plasma_server(engine, LIMITS, self._patch, self._folder)
            else:
                self._own = ShmServer(engine, LIMITS, NoKey.OPEN)
            self._own.open()
            self._start()
        if endpoint == "own port":
            return WebSocketLine(self._own.address.port, self._own.path)
        if endpoint == "plasma":
            return UnixLine(
                self._own.plasma.socket,
                lambda message, data: PlasmaChannel.frames.update({message[:28]: data}),
            )
        return UnixLine(f"\0{self._own.address.socket}")

    def _handle(self, engine: Engine, name: str) -> Line:
        from vlagents_ray.serve.replica.replica import answer_frame

        call = partial(answer_frame, engine, LIMITS, f"session-{name}")
        return CallLine(lambda data, _: ("binary", masked(asyncio.run(call(data)))))

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
            NoKey.OPEN,
        )
        dialect = cls(name, cls.Config(port=port, **self._dialects[name]), context)
        dialect.serve(reserve(name, "127.0.0.1", port))
        self._stack.callback(dialect.close)
        self._gateway_port = port
