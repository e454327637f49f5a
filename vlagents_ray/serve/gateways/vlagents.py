"""The door for clients of the package `vlagents`: RPyC, a thread a client, a session a client."""

from __future__ import annotations

import logging
import socket
import threading
import time

from vlagents_ray.contract import ActionSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.gateways.config import GripperArgs, VlagentsArgs
from vlagents_ray.serve.gateways.door import House, listen
from vlagents_ray.serve.gateways.vlagents_client import Client, Terms, hang_up
from vlagents_ray.wire import vlagents
from vlagents_ray.wire.presets import read_mapping

logger = logging.getLogger(__name__)

_END_S = 3.0


class VlagentsDoor:
    """Listens on a socket that is bound already."""

    def __init__(self, house: House, args: VlagentsArgs, listener: socket.socket, version: str) -> None:
        if house.check is not None and not args.without_key:
            raise ConfigError(
                "dialects.vlagents: the server wants API keys, and this protocol has none; take the door away, or "
                "let everybody in here who reaches its port: without_key: true"
            )
        self._house = house
        self._listener = listener
        self._terms = Terms(
            name=args.name or house.app,
            version=version,
            shared_memory=args.shared_memory,
            mapping=None if args.mapping is None else read_mapping(args.mapping),
            parts=self._parts(args),
        )
        self._clients: dict[threading.Thread, socket.socket] = {}
        self._lock = threading.Lock()
        self._closing = False
        self._accepting = threading.Thread(target=self._accept, name="vlagents-door", daemon=True)

    def open(self) -> None:
        """Let clients in."""
        listen(self._listener)
        self._accepting.start()

    def alive(self) -> bool:
        """Does it still let clients in?"""
        return self._accepting.is_alive()

    def close(self) -> None:
        """Hang up on everybody; their sessions end."""
        self._closing = True
        hang_up(self._listener)
        with self._lock:
            clients = dict(self._clients)
        for connection in clients.values():
            hang_up(connection)
        deadline = time.monotonic() + _END_S
        if self._accepting.ident is not None:
            self._accepting.join(_END_S)
        self._listener.close()
        for thread in clients:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _accept(self) -> None:
        while not self._stopped():
            try:
                connection, peer = self._listener.accept()
            except OSError as error:
                if self._stopped():
                    break
                logger.warning("vlagents: cannot let a client in: %s", error)
                time.sleep(0.1)  # out of descriptors: others have to leave first
                continue
            client = Client(self._house, self._terms, connection)
            thread = threading.Thread(target=self._serve, args=(client,), name=f"vlagents {peer[0]}", daemon=True)
            with self._lock:
                full = len(self._clients) >= self._house.sessions
                if not full:
                    self._clients[thread] = connection
            if full:
                logger.warning(
                    "vlagents: %d clients are connected, the limit; one was turned away", self._house.sessions
                )
                connection.close()
            else:
                thread.start()

    def _stopped(self) -> bool:
        return self._closing

    def _serve(self, client: Client) -> None:
        try:
            client.run()
        finally:
            with self._lock:
                del self._clients[threading.current_thread()]

    def _parts(self, args: VlagentsArgs) -> dict[str, vlagents.Part] | vlagents.Part:
        if args.robots:
            return {name: self._part(robot.start, robot.stop, robot.gripper) for name, robot in args.robots.items()}
        return self._part(None, None, args.gripper)

    def _part(self, start: int | None, stop: int | None, gripper: GripperArgs | None) -> vlagents.Part:
        if gripper is None:
            return vlagents.Part(start, stop)
        spec = ActionSpec() if self._house.contract is None else self._house.contract.action
        return vlagents.Part(
            start,
            stop,
            gripper.column,
            _first(gripper.open, spec.gripper_open, 1.0),
            _first(gripper.closed, spec.gripper_closed, 0.0),
        )


def _first(*values: float | None) -> float:
    return next(value for value in values if value is not None)
