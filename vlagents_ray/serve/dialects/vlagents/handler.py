"""Clients of the package `vlagents` over RPyC, with one thread and one session per client."""

from __future__ import annotations

import importlib.metadata
import logging
import socket
import threading
import time
from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.serve.config.dialects import DialectConfig, KeylessPortConfig
from vlagents_ray.serve.dialects.base import GatewayContext, PortDialect
from vlagents_ray.serve.dialects.vlagents import codec as vlagents_codec
from vlagents_ray.serve.dialects.vlagents.connection import Terms, VlagentsConnection, shut_down

logger = logging.getLogger(__name__)

_END_S = 3.0


class GripperArgs(BaseModel):
    """The column of a robot's gripper in a row of the policy's actions, and its values."""

    model_config = ConfigDict(extra="forbid")

    column: int = Field(default=-1, description="as in Python: -1 is the last")
    open: float | None = Field(default=None, description="its value for open; default: the policy's contract, or 1")
    closed: float | None = Field(default=None, description="and for closed; default: the policy's contract, or 0")

    @model_validator(mode="after")
    def _two_values(self) -> GripperArgs:
        if self.open is not None and self.open == self.closed:
            raise ValueError(f"open and closed are both {self.open}; they must differ")
        return self


class RobotArgs(BaseModel):
    """The columns of one robot in a row."""

    model_config = ConfigDict(extra="forbid")

    start: int | None = None
    stop: int | None = None
    gripper: GripperArgs | None = Field(
        default=None, description="the column that goes into SingleAct.gripper; unset: none"
    )


class VlagentsDialectConfig(KeylessPortConfig):
    """The settings of the RPyC protocol of the package `vlagents`, 0.2 and 0.3.

    A mapping reads cameras/NAME, state/NAME, gripper, info; without one, the client's names stay as they are.
    """

    port: int = Field(default=8080, ge=1, le=65535)
    name: str | None = Field(
        default=None, description="the model's name, which clients must give; default: the application's"
    )
    gripper: GripperArgs | None = Field(
        default=None, description="of the only robot: the column that goes into SingleAct.gripper; unset: none"
    )
    robots: dict[str, RobotArgs] = Field(default_factory=dict, description="with several, which columns are whose")
    shared_memory: bool = Field(default=True, description="read the cameras of clients on this machine in place")

    @model_validator(mode="after")
    def _one_way(self) -> VlagentsDialectConfig:
        if self.gripper is not None and self.robots:
            raise ValueError("gripper is for a single robot; with robots, state each robot's own")
        return self


class VlagentsDialect(PortDialect):
    """The protocol of the package `vlagents`, with one thread and one session per client."""

    Config = VlagentsDialectConfig
    clients = "vlagents"
    summary = (
        "A session is the connection; an episode begins with `reset` and with each new instruction. An error "
        "is raised at the client as a built-in exception."
    )
    scheme = "rpyc"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        # our own names, for clients that need a mapping but whose protocol defines no names
        "vlagents": {
            "cameras": {"*": "cameras/*"},
            "state": {"*": "state/*"},
            "gripper": {"key": "gripper", "optional": True},
            "instruction": "instruction",
            "info": {"info": "info"},
        },
    }
    config: VlagentsDialectConfig

    def __init__(self, name: str, config: VlagentsDialectConfig, context: GatewayContext) -> None:
        super().__init__(name, config, context)
        self._terms = Terms(
            name=config.name or context.app,
            version=importlib.metadata.version("vlagents-ray"),
            shared_memory=config.shared_memory,
            mapping=config.keys(),
            parts=self._parts(config),
        )
        self._clients: dict[threading.Thread, socket.socket] = {}
        self._lock = threading.Lock()
        self._closing = False
        self._listener: socket.socket | None = None
        self._accepting: threading.Thread | None = None

    @classmethod
    def lacks(cls, config: DialectConfig, contract: Contract | None) -> list[str]:  # noqa: ARG003 - overrides
        """Return nothing: the instruction is sent beside the observation, and `robots` states each robot's columns."""
        return []

    def serve(self, listener: socket.socket) -> None:
        listener.listen()
        self._listener = listener
        self._accepting = threading.Thread(target=self._accept, args=(listener,), name="vlagents", daemon=True)
        self._accepting.start()

    def alive(self) -> bool:
        return self._accepting is not None and self._accepting.is_alive()

    def close(self) -> None:
        self._closing = True
        if self._listener is not None:
            shut_down(self._listener)
        with self._lock:
            clients = dict(self._clients)
        for connection in clients.values():
            shut_down(connection)
        deadline = time.monotonic() + _END_S
        if self._accepting is not None:
            self._accepting.join(_END_S)
        if self._listener is not None:
            self._listener.close()
        for thread in clients:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _accept(self, listener: socket.socket) -> None:
        while not self._stopped():
            try:
                connection, peer = listener.accept()
            except OSError as error:
                if self._stopped():
                    break
                logger.warning("vlagents: cannot accept a client: %s", error)
                time.sleep(0.1)  # if descriptors are exhausted, other connections have to end first
                continue
            client = VlagentsConnection(self.context, self._terms, connection)
            thread = threading.Thread(target=self._serve, args=(client,), name=f"vlagents {peer[0]}", daemon=True)
            with self._lock:
                full = len(self._clients) >= self.context.sessions
                if not full:
                    self._clients[thread] = connection
            if full:
                logger.warning("vlagents: %d clients are connected, the limit; one was refused", self.context.sessions)
                connection.close()
            else:
                thread.start()

    def _stopped(self) -> bool:
        return self._closing

    def _serve(self, client: VlagentsConnection) -> None:
        try:
            client.run()
        finally:
            with self._lock:
                del self._clients[threading.current_thread()]

    def _parts(self, config: VlagentsDialectConfig) -> dict[str, vlagents_codec.Part] | vlagents_codec.Part:
        if config.robots:
            return {name: self._part(robot.start, robot.stop, robot.gripper) for name, robot in config.robots.items()}
        return self._part(None, None, config.gripper)

    def _part(self, start: int | None, stop: int | None, gripper: GripperArgs | None) -> vlagents_codec.Part:
        if gripper is None:
            return vlagents_codec.Part(start, stop)
        spec = ActionSpec() if self.context.contract is None else self.context.contract.action
        return vlagents_codec.Part(
            start,
            stop,
            gripper.column,
            _first(gripper.open, spec.gripper_open, 1.0),
            _first(gripper.closed, spec.gripper_closed, 0.0),
        )


def _first(*values: float | None) -> float:
    return next(value for value in values if value is not None)
