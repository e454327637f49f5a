"""The connection of a replica to the policy in its child process."""

from __future__ import annotations

import itertools
import queue
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.errors import ConnectionLost, PolicyFailed, PolicyUnavailable, VLAgentsError
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import LocalAddress, Op, Reply, Request
from vlagents_ray.serve.engine.ability_call import name_of
from vlagents_ray.serve.models.loaded_model import GpuWork
from vlagents_ray.serve.python_env.child_process import ChildProcess, LoadedPolicy

# Calls have no time limit here: as for any policy, Serve replaces a replica with an overdue call.
_FOREVER_S = 1e6
_CONNECT_S = 10.0


class ChildConnection:
    """The calls of a replica to the engine in its child process, and its sessions there.

    The calls are sent through shared memory (`vlagents_ray.client.transports.shm`): a batch is one
    message, and each session of the replica has a session in the child. Since each channel has one
    message at a time, there are separate channels for calls that run while the policy computes, and
    for each thread that sends observations in advance. All methods may be called from any thread.
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
        # Channels for `IMMEDIATE_OPS` that no thread uses at the moment.
        self._immediate: queue.SimpleQueue[_Channel] = queue.SimpleQueue()
        self._numbers = itertools.count(1)  # numbers of stored observations

        # Whether the policy has an ability, by the name of the ability's protocol.
        self._abilities: dict[str, bool] = {}
        self._names = itertools.count(1)  # numbers of sessions
        self._free: deque[str] = deque()  # names of closed sessions
        # Names of the sessions to close, numbers of the versions of weights to drop, and messages
        # that drop stored observations; None ends the thread that sends them.
        self._dropped: queue.SimpleQueue[str | int | Request | None] = queue.SimpleQueue()
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

    def call_at_once(self, request: Request) -> dict[str, Any]:
        """Make a call, one of `IMMEDIATE_OPS`, on a separate channel; return its result.

        Raises:
            ConnectionLost: The process has ended.
            VLAgentsError: Any error of the call.
        """
        try:
            channel = self._immediate.get_nowait()
        except queue.Empty:
            channel = _Channel(self.process, self.policy.address)
        try:
            [reply] = channel.call([request])
        finally:
            self._immediate.put(channel)
        if reply.error is not None:
            raise reply.error
        return reply.info or {}

    def store(self, session: str, obs: Obs) -> StoredObservation:
        """Send an observation for a later act of a session, which the child begins to prepare.

        Raises:
            ConnectionLost: The process has ended.
            VLAgentsError: The child has rejected the observation.
        """
        number = next(self._numbers)
        request = Request("prepare", obs, session=session, kwargs={"number": number})
        self.call_at_once(request)
        return StoredObservation(self, session, number)

    def gpu_memory(self) -> dict[str, int]:
        """Return the memory of the GPUs of the process, see `accelerator.gpu_memory`; empty if the
        process has ended.
        """
        try:
            memory: dict[str, int] = self.call_at_once(Request("gpu_memory"))["bytes"]
        except VLAgentsError:
            return {}
        return memory

    def gpu_work(self) -> GpuWork:
        """Return the GPU work of the process since the last call; empty if the process
        has ended.
        """
        try:
            return GpuWork(**self.call_at_once(Request("gpu_work")))
        except VLAgentsError:
            return GpuWork()

    def call_for_weights(self, op: Op, **arguments: Any) -> dict[str, Any]:
        """Make a call for the weights; see `call_in_background`."""
        try:
            return self.call_in_background(op, **arguments)
        except ConnectionLost as error:
            raise PolicyUnavailable(
                f"weights: {error}, so that nothing was changed; push again"
            ) from error

    def has(self, protocol: type) -> bool:
        """Return whether the loaded policy has an ability. The process is asked only once for each
        ability.
        """
        name = name_of(protocol)
        if name not in self._abilities:
            answer = self.call_in_background("ability", protocol=name)
            self._abilities[name] = answer["available"]
        return self._abilities[name]

    def open_session(self) -> str:
        """Return a name for a new session. Names are reused, since each name takes memory until the
        connection ends.
        """
        try:
            name = self._free.popleft()
        except IndexError:
            name = f"{next(self._names):x}"
        self.sessions.add(name)
        return name

    def drop(self, name: str | int | Request) -> None:
        """Close a session, drop a version of the weights, or send a message about a stored
        observation on another thread, soon. The garbage collector may call this method at any time.
        """
        self._dropped.put(name)

    def close(self) -> None:
        """Close the policy, and end its process and the connection."""
        self._dropped.put(None)
        self.process.close()  # a hanging call ends when its process ends
        self._acts.close()
        self._background.close()
        while not self._immediate.empty():
            self._immediate.get().close()

    def _close_dropped(self) -> None:
        """Close the dropped sessions, and drop versions of the weights and observations, until the
        process ends.
        """
        while (name := self._dropped.get()) is not None:
            try:
                if isinstance(name, Request):
                    self.call_at_once(name)
                    continue
                if isinstance(name, int):
                    self.call([Request("weights", kwargs={"forget": name})])
                    continue
                self.call([Request("close", session=name)])
            except VLAgentsError:  # the process and therefore its sessions have ended
                return
            self.sessions.discard(name)
            self._free.append(name)


@dataclass(slots=True, eq=False)
class StoredObservation:
    """A reference to an observation in the child, which keeps the observation until an act refers
    to it, or until this reference is dropped.
    """

    connection: ChildConnection
    session: str  # name of the session to which the observation belongs
    number: int
    is_named: bool = False  # whether an act has referred to it

    def waits_for(self, connection: ChildConnection, session: str) -> bool:
        """Return whether the child still stores the observation for an act of the given session."""
        return not self.is_named and self.connection is connection and self.session == session

    def __del__(self) -> None:
        if not self.is_named:
            self.connection.drop(
                Request("prepare", session=self.session, kwargs={"number": self.number})
            )


class _Channel:
    """One connection to the engine in a child process, with one message at a time."""

    def __init__(self, process: ChildProcess, address: LocalAddress) -> None:
        self._process = process
        self._transport = ShmTransport(address)
        self._transport.connect(_CONNECT_S)
        self._lock = threading.Lock()  # held during a call
        self._numbers = itertools.count(1)  # numbers of requests

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

        if len(replies) != len(requests):  # the only reply, to the whole message
            raise replies[0].error or PolicyFailed(
                f"expected {len(requests)} replies, one for each request, got {len(replies)}"
            )
        return replies

    def close(self) -> None:
        """End the connection after the running call."""
        with self._lock:
            self._transport.close()
