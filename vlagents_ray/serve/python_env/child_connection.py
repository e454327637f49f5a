"""The connection of a replica to the policy in its child process."""

from __future__ import annotations

import itertools
import queue
import threading
from collections import deque
from collections.abc import Sequence
from typing import Any

from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.errors import ConnectionLost, PolicyFailed, PolicyUnavailable, VLAgentsError
from vlagents_ray.protocol.messages import LocalAddress, Op, Reply, Request
from vlagents_ray.serve.engine.ability_call import name_of
from vlagents_ray.serve.python_env.child_process import ChildProcess, LoadedPolicy

# Calls have no time limit here: as for any policy, Serve replaces a replica with an overdue call.
_FOREVER_S = 1e6
_CONNECT_S = 10.0


class ChildConnection:
    """The calls of a replica to the engine in its child process, and its sessions there.

    They are sent through shared memory (`vlagents_ray.client.transports.shm`): a batch is one
    message, and each session of the replica has a session in the child. Calls that run while the
    policy acts have a channel of their own, as each channel has one message at a time. All methods
    may be called from any thread.
    """

    def __init__(self, process: ChildProcess, policy: LoadedPolicy) -> None:
        """Connect to the loaded policy of a process.

        Raises:
            PolicyUnavailable: The process does not answer.
        """
        self.process = process
        self.policy = policy
        self.sessions: set[str] = set()  # names of the sessions in the child
        self._acts = _Channel(process, policy.address)
        self._background = _Channel(process, policy.address)

        # Whether the policy has an ability, by the name of its protocol.
        self._abilities: dict[str, bool] = {}
        self._names = itertools.count(1)  # numbers of sessions
        self._free: deque[str] = deque()  # names of closed sessions
        # Names of the sessions, and of the versions of weights, to close; None ends the thread that
        # closes them.
        self._dropped: queue.SimpleQueue[str | int | None] = queue.SimpleQueue()
        closer = threading.Thread(
            target=self._close_dropped, name="policy-process-sessions", daemon=True
        )
        closer.start()

    def call(self, requests: Sequence[Request]) -> list[Reply]:
        """Send requests in one message to the policy's thread, and return their replies.

        Raises:
            ConnectionLost: The process has ended.
            VLAgentsError: The child has rejected the message.
        """
        try:
            return self._acts.call(requests)
        except ConnectionLost as error:
            raise ConnectionLost(f"{error}; the replica is being replaced") from error

    def ask(self, request: Request) -> Reply:
        """Send one request to the policy's thread, and return its reply, or raise the error in
        it.
        """
        [reply] = self.call([request])
        if reply.error is not None:
            raise reply.error
        return reply

    def call_in_background(self, op: Op, **arguments: Any) -> dict[str, Any]:
        """Make a call, one of `BACKGROUND_OPS`, while the policy acts; return its result.

        Raises:
            ConnectionLost: The process has ended.
            VLAgentsError: Any error of the call.
        """
        [reply] = self._background.call([Request(op, kwargs=arguments)])
        if reply.error is not None:
            raise reply.error
        return reply.info or {}

    def call_for_weights(self, op: Op, **arguments: Any) -> dict[str, Any]:
        """Make a call for the weights, as `call_in_background` does."""
        try:
            return self.call_in_background(op, **arguments)
        except ConnectionLost as error:
            raise PolicyUnavailable(
                f"weights: {error}, so that nothing was changed; push again"
            ) from error

    def has(self, protocol: type) -> bool:
        """Return whether the loaded policy has an ability; the process is asked once for each."""
        name = name_of(protocol)
        if name not in self._abilities:
            answer = self.call_in_background("ability", protocol=name)
            self._abilities[name] = answer["available"]
        return self._abilities[name]

    def open_session(self) -> str:
        """Return a name for a new session; names are reused, since each takes memory until the
        connection ends.
        """
        try:
            name = self._free.popleft()
        except IndexError:
            name = f"{next(self._names):x}"
        self.sessions.add(name)
        return name

    def drop(self, name: str | int) -> None:
        """Close a session, or drop a version of the weights, soon; the garbage collector may
        call this at any time.
        """
        self._dropped.put(name)

    def close(self) -> None:
        """Close the policy, and end its process and the connection."""
        self._dropped.put(None)
        self.process.close()  # a call that hangs ends with its process
        self._acts.close()
        self._background.close()

    def _close_dropped(self) -> None:
        """Close the dropped sessions, and drop versions of the weights, until the process ends."""
        while (name := self._dropped.get()) is not None:
            try:
                if isinstance(name, int):
                    self.call([Request("weights", kwargs={"forget": name})])
                    continue
                self.call([Request("close", session=name)])
            except VLAgentsError:  # the process has ended, and its sessions with it
                return
            self.sessions.discard(name)
            self._free.append(name)


class _Channel:
    """One connection to the engine in a child process, with one message at a time."""

    def __init__(self, process: ChildProcess, address: LocalAddress) -> None:
        self._process = process
        self._transport = ShmTransport(address)
        self._transport.connect(_CONNECT_S)
        self._lock = threading.Lock()  # held during a call
        self._numbers = itertools.count(1)  # of requests

    def call(self, requests: Sequence[Request]) -> list[Reply]:
        """Send requests in one message, and return their replies; raise `ConnectionLost` if the
        process has ended.
        """
        for request in requests:
            request.request_id = f"{next(self._numbers):x}"

        with self._lock:
            try:
                replies = self._transport.call(requests, _FOREVER_S)
            except PolicyUnavailable as error:
                raise ConnectionLost(self._process.describe_end()) from error

        if len(replies) != len(requests):  # a single reply to the whole message
            raise replies[0].error or PolicyFailed(
                f"expected {len(requests)} replies, one for each request, got {len(replies)}"
            )
        return replies

    def close(self) -> None:
        """End the connection after the running call."""
        with self._lock:
            self._transport.close()
