"""The process behind a replica that runs its policy, as the replica sees it: see `host` for the other side.

What the replica's engine asks of the policy travels through shared memory (`vlagents_ray.client.shm`) to an engine in
the child: a batch as one message, a session as a session.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import queue
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from vlagents_ray.client.shm import ShmTransport
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, ConnectionLost, PolicyFailed, PolicyUnavailable, VLAgentsError
from vlagents_ray.serve.environments import host
from vlagents_ray.serve.environments.host import Settings
from vlagents_ray.wire.messages import Reply, Request

_FOREVER_S = 1e6  # a policy may think as long as it likes: whoever asked it has a deadline
_CONNECT_S = 10.0
_CLOSE_S = 10.0
_EXIT_S = 2.0
_LAST_WORDS = 20  # lines


class Child:
    """The process. It ends with this one, however that ends. `call` and what follows may come from any thread."""

    def __init__(self, python: str, settings: Settings, env_vars: Mapping[str, str]) -> None:
        self.contract: Contract | None = None  # once it has started
        self.sessions: set[str] = set()  # what it holds, by their names
        self._python = python
        self._settings = settings
        self._env_vars = env_vars
        self._process: subprocess.Popen[bytes] | None = None
        self._spawned: queue.SimpleQueue[subprocess.Popen[bytes] | OSError] = queue.SimpleQueue()
        self._last_words: deque[str] = deque(maxlen=_LAST_WORDS)
        self._transport: ShmTransport | None = None
        self._lock = threading.Lock()
        self._requests = itertools.count(1)
        self._names = itertools.count(1)
        self._free: deque[str] = deque()
        self._left: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._closed = False

    def start(self) -> None:
        """Start it, and return when the policy is loaded; `ConfigError`, `PolicyFailed` if that fails."""
        # The kernel kills the child when the thread that started it ends: this one ends after the child.
        keeper = threading.Thread(target=self._keep, name="policy-process", daemon=True)
        keeper.start()
        spawned = self._spawned.get()
        if isinstance(spawned, OSError):
            raise ConfigError(f"environment.python: {self._python!r} cannot be started here ({spawned})") from spawned
        self._process = spawned
        try:
            said = self._introduced(spawned, keeper)
            self._transport = ShmTransport(said["local"])
            self._transport.connect(_CONNECT_S)
        except BaseException:
            self.close()
            raise
        self.contract = None if said["contract"] is None else Contract.from_json(said["contract"])
        threading.Thread(target=self._close_sessions, name="policy-process-sessions", daemon=True).start()

    def call(self, requests: Sequence[Request]) -> list[Reply]:
        """The replies to requests that travel together; `ConnectionLost` if the process has ended."""
        if self._transport is None:
            raise PolicyUnavailable("the policy's process has not started")
        for request in requests:
            request.request_id = f"{next(self._requests):x}"
        with self._lock:
            try:
                replies = self._transport.call(requests, _FOREVER_S)
            except PolicyUnavailable as error:
                raise ConnectionLost(f"{self._ended()}; the replica is being replaced") from error
        if len(replies) != len(requests):  # an answer to the message as a whole
            raise replies[0].error or PolicyFailed(f"got {len(replies)} replies to {len(requests)} requests")
        return replies

    def open_session(self) -> str:
        """A name for a new session. Names are few, and used again: each costs a connection a little for good."""
        try:
            name = self._free.popleft()
        except IndexError:
            name = f"{next(self._names):x}"
        self.sessions.add(name)
        return name

    def close_session(self, name: str) -> None:
        """Forget a session soon. Waits for nothing, as garbage collection may call it at any moment."""
        self._left.put(name)

    def require_alive(self) -> None:
        """`PolicyUnavailable` if the process has ended."""
        if self._process is None or self._process.poll() is not None:
            raise PolicyUnavailable(self._ended())

    def close(self) -> None:
        """Let the policy close itself, and end the process."""
        process = self._process
        if process is None or self._closed:
            return
        self._closed = True
        self._left.put(None)
        _write(process, b"\n")
        try:
            process.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        with self._lock:
            if self._transport is not None:
                self._transport.close()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()

    def _introduced(self, process: subprocess.Popen[bytes], keeper: threading.Thread) -> dict[str, Any]:
        """What the process says once its policy is loaded; raises what kept it from that."""
        _write(process, json.dumps(asdict(self._settings)).encode() + b"\n")
        line = b"" if process.stdout is None else process.stdout.readline()
        if not line:
            keeper.join(_EXIT_S)
            raise PolicyFailed(f"{self._ended()}; it said:\n{''.join(self._last_words).strip()}")
        said: dict[str, Any] = json.loads(line)
        if "error" in said:
            raise PolicyFailed(f"in {self._python}: {said['error']}")
        return said

    def _keep(self) -> None:
        """Start the process, pass on what it says for people, and stay until its end."""
        try:
            process = subprocess.Popen(  # noqa: S603 - the deployment's own interpreter
                [self._python, "-m", host.__name__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env={**os.environ, **self._env_vars},
            )
        except OSError as error:
            self._spawned.put(error)
            return
        self._spawned.put(process)
        if process.stderr is not None:
            with process.stderr as stream:
                for line in stream:
                    text = line.decode(errors="replace")
                    self._last_words.append(text)
                    sys.stderr.write(text)
        process.wait()

    def _close_sessions(self) -> None:
        while (name := self._left.get()) is not None:
            try:
                self.call([Request("close", session=name)])
            except VLAgentsError:  # the process has ended, and its sessions with it
                return
            self.sessions.discard(name)
            self._free.append(name)

    def _ended(self) -> str:
        """What became of it, for clients too; its pipes and sockets close a moment before its exit status is known."""
        if self._process is None:
            return "the policy's process has not started"
        try:
            return f"the policy's process ended with exit status {self._process.wait(_EXIT_S)}"
        except subprocess.TimeoutExpired:
            return "the policy's process hung up"


def _write(process: subprocess.Popen[bytes], data: bytes) -> None:
    """To its standard input; one that has ended is noticed elsewhere."""
    if process.stdin is not None:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(data)
            process.stdin.flush()
