"""The agent of a replica: the policy itself, or a proxy for one that runs in a child process."""

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
from typing import Any, BinaryIO, ClassVar, TypeVar, cast
from weakref import WeakKeyDictionary, finalize

import numpy as np

from vlagents_ray.abilities import InProcess, is_marked
from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    ConfigError,
    ConnectionLost,
    NotReset,
    NotTrainable,
    PolicyFailed,
    PolicyUnavailable,
    VLAgentsError,
)
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.loading import report_device, report_progress, report_uncompiled
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.protocol.frames import read_error
from vlagents_ray.protocol.messages import LocalAddress, Reply, Request
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.engine.ability_call import AbilityCall, is_method, name_of
from vlagents_ray.serve.python_env import child_main
from vlagents_ray.serve.python_env.child_main import Settings
from vlagents_ray.serve.weights import HoldsWeights, ModelWeights, PushOptions, WeightsVersion
from vlagents_ray.weights.safetensors import ValueSpec, read_values, write_values
from vlagents_ray.weights.shared_values import NotShared, SharedValues
from vlagents_ray.weights.trainable import portable, require_fit

T = TypeVar("T")

# Calls have no time limit here: as for any policy, Serve replaces a replica with an overdue call.
_FOREVER_S = 1e6
_CONNECT_S = 10.0
_CLOSE_S = 10.0
_EXIT_S = 2.0
_LAST_LINES = 20  # number of lines at the end of the child's error output that an error quotes


class Child:
    """A child process, which ends when this process ends for any reason; the other side is
    `child_main`.

    Calls of the replica's engine to the policy are sent through shared memory
    (`vlagents_ray.client.transports.shm`) to an engine in the child: a batch is one message, and
    each session has a session in the child.

    `call` and the methods below it may be called from any thread.
    """

    def __init__(self, python: str, settings: Settings, env_vars: Mapping[str, str]) -> None:
        # The process's description of the loaded policy, see `child_main`.
        self.loaded: dict[str, Any] = {}
        self.sessions: set[str] = set()  # names of the sessions in the child
        # Whether the policy has an ability, by the name of its protocol.
        self._abilities: dict[str, bool] = {}
        self._python = python
        self._settings = settings
        self._env_vars = env_vars

        self._process: subprocess.Popen[bytes] | None = None
        self._spawned: queue.SimpleQueue[subprocess.Popen[bytes] | OSError] = queue.SimpleQueue()
        self._last_lines: deque[str] = deque(maxlen=_LAST_LINES)  # of the child's error output
        self._transport: ShmTransport | None = None
        self._lock = threading.Lock()  # held during a call through shared memory
        self._calling = threading.Lock()  # held during a call for the weights

        self._requests = itertools.count(1)  # numbers of requests
        self._names = itertools.count(1)  # numbers of sessions
        self._free: deque[str] = deque()  # names of closed sessions
        # Names of the sessions, and of the versions of weights, to close; None ends the thread that
        # closes them.
        self._dropped: queue.SimpleQueue[str | int | None] = queue.SimpleQueue()
        self._closed = False

    def start(self) -> None:
        """Start the process, and return when the policy is loaded.

        Raises:
            ConfigError: The interpreter cannot be started.
            PolicyFailed: The policy did not load.
        """
        # The kernel kills the child when the thread that started it ends; this thread ends after
        # the child.
        runner = threading.Thread(target=self._run_process, name="policy-process", daemon=True)
        runner.start()
        process = self._spawned.get()
        if isinstance(process, OSError):
            raise ConfigError(
                f"environment.python: {self._python!r} cannot be started here ({process})"
            ) from process

        self._process = process
        try:
            self.loaded = self._wait_until_loaded(process, runner)
            self._transport = ShmTransport(LocalAddress(**self.loaded["local"]))
            self._transport.connect(_CONNECT_S)
        except BaseException:
            self.close()
            raise

        closer = threading.Thread(
            target=self._close_sessions, name="policy-process-sessions", daemon=True
        )
        closer.start()

    def call(self, requests: Sequence[Request]) -> list[Reply]:
        """Send requests in one message and return their replies; raise `ConnectionLost` if the
        process has ended.
        """
        if self._transport is None:
            raise PolicyUnavailable("the policy's process has not started")
        for request in requests:
            request.request_id = f"{next(self._requests):x}"

        with self._lock:
            try:
                replies = self._transport.call(requests, _FOREVER_S)
            except PolicyUnavailable as error:
                raise ConnectionLost(
                    f"{self._describe_end()}; the replica is being replaced"
                ) from error

        if len(replies) != len(requests):  # a single reply to the whole message
            raise replies[0].error or PolicyFailed(
                f"expected {len(requests)} replies, one for each request, got {len(replies)}"
            )
        return replies

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

    def has(self, protocol: type) -> bool:
        """Return whether the loaded policy has an ability; the process is asked once for each."""
        if self._process is None:
            return False
        name = name_of(protocol)
        if name not in self._abilities:
            self._abilities[name] = self.call_beside_acts(protocol=name)["has"]
        return self._abilities[name]

    def call_for_weights(self, **call: Any) -> dict[str, Any]:
        """Let the process execute a call for its weights, as `call_beside_acts` does."""
        try:
            return self.call_beside_acts(**call)
        except ConnectionLost as error:
            raise PolicyUnavailable(
                f"weights: {error}, so that nothing was changed; push again"
            ) from error

    def call_beside_acts(self, **call: Any) -> dict[str, Any]:
        """Let the process execute a call (see `child_main`) while it acts, and return the result
        or raise its error; raise `ConnectionLost` if the process ends meanwhile.
        """
        with self._calling:
            process = self._process
            if process is None or process.stdout is None:
                raise PolicyUnavailable(self._describe_end())
            _write(process, json.dumps(call).encode() + b"\n")
            line = process.stdout.readline()
        if not line:
            raise ConnectionLost(self._describe_end())

        answer: dict[str, Any] = json.loads(line)
        if "code" in answer:
            error = read_error(answer)
            raise NotShared(str(error)) if answer.get("not_shared") else error
        return answer

    def require_alive(self) -> None:
        """Raise `PolicyUnavailable` if the process has ended."""
        if self._process is None or self._process.poll() is not None:
            raise PolicyUnavailable(self._describe_end())

    def close(self) -> None:
        """Close the policy, and end the process."""
        process = self._process
        if process is None or self._closed:
            return

        self._closed = True
        self._dropped.put(None)
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

    def _wait_until_loaded(
        self, process: subprocess.Popen[bytes], runner: threading.Thread
    ) -> dict[str, Any]:
        """Return the document that the process sends when its policy is loaded; raise
        `PolicyFailed` otherwise.
        """
        _write(process, json.dumps(asdict(self._settings)).encode() + b"\n")
        while True:
            line = b"" if process.stdout is None else process.stdout.readline()
            if not line:
                runner.join(_EXIT_S)
                output = "".join(self._last_lines).strip()
                raise PolicyFailed(f"{self._describe_end()}; last output:\n{output}")
            document: dict[str, Any] = json.loads(line)
            if "step" not in document:
                break
            report_progress(document["step"])

        if "error" in document:
            raise PolicyFailed(f"in {self._python}: {document['error']}")
        for module in document["uncompiled"]:
            report_uncompiled(module)
        for device in document["devices"]:
            report_device(device)
        return document

    def _run_process(self) -> None:
        """Start the process, copy its error output to that of this process, and wait until it
        ends.
        """
        try:
            process = subprocess.Popen(  # noqa: S603 - the deployment's own interpreter
                [self._python, "-m", child_main.__name__],
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
                    self._last_lines.append(text)
                    sys.stderr.write(text)
        process.wait()

    def _close_sessions(self) -> None:
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

    def _describe_end(self) -> str:
        """Return a sentence about the end of the process; its exit status is known shortly after
        its sockets close.
        """
        if self._process is None:
            return "the policy's process has not started"
        try:
            return f"the policy's process ended with exit status {self._process.wait(_EXIT_S)}"
        except subprocess.TimeoutExpired:
            return "the policy's process closed the connection"


def _write(process: subprocess.Popen[bytes], data: bytes) -> None:
    """Write to the process's standard input; a process that has ended is detected elsewhere."""
    if process.stdin is not None:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(data)
            process.stdin.flush()


def make_agent(args: ServerArgs, config: Mapping[str, Any]) -> Agent:
    """Build the policy with the settings `config`, or the proxy for a child process, without
    loading it.

    `args.environment.process` must be decided, see `probe.with_process`.
    """
    environment = args.environment
    if environment.python is not None and environment.process == "child":
        settings = Settings(
            policy=args.policy,
            config=dict(config),
            batch=args.batch.max_size,
            version=version_of(args),
            wrappers=args.wrappers,
        )
        return ChildAgent(Child(environment.python, settings, environment.env_vars))
    return build_agent(args.policy, config, args.wrappers)


def version_of(args: ServerArgs) -> str:
    """Return a text that is equal in replicas between which sessions can move.

    It covers the policy, wrappers and environment, since pickles of one environment are valid in no
    other.
    """
    return json.dumps([args.policy, args.wrappers, args.environment.model_dump()], sort_keys=True)


class ChildAgent(Agent, HoldsWeights):
    """Proxy for the policy in a child process; a copy is one of its sessions and moves to
    another child by pickling.
    """

    shared: ClassVar[tuple[str, ...]] = ("_child",)

    def __init__(self, child: Child) -> None:
        self._child = child
        self._session: str | None = None  # None until `reset`

    @property
    def contract(self) -> Contract | None:
        contract = self._child.loaded.get("contract")
        return None if contract is None else Contract.from_json(contract)

    def initialize(self) -> None:
        self._child.start()
        self.weights_id = self._child.loaded["weights"]

    def model_weights(
        self, busy: threading.Lock, digest: str, model: tuple[str, str]
    ) -> ModelWeights:
        return ChildWeights(self, self._child, busy, digest, model)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        if self._session is None:
            self._session = self._child.open_session()
        return self._ask(Request("reset", obs, instruction, kwargs)).info or {}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Send the observations in one message; return the action or the error of each."""
        requests = []
        for session, session_obs in zip(sessions, obs, strict=True):
            if isinstance(session, ChildAgent):
                requests.append(Request("act", session_obs, session=session._session or ""))

        missing = PolicyFailed("act: the policy's process answered without an action")
        return [reply.error or reply.act or missing for reply in self._child.call(requests)]

    def forwarded(self, protocol: type[T]) -> T | None:
        """Return an ability of the policy in the child, whose arguments and results are sent.

        An ability whose values cannot be sent (`InProcess`) is used by the child itself: it
        prepares observations, replaces weights and checks its health.
        """
        if is_marked(protocol, InProcess) or not self._child.has(protocol):
            return None
        return cast(T, _AbilityInChild(self, protocol))

    def use_ability(self, call: AbilityCall, obs: Obs | None) -> Any:
        """Let the child use an ability of this session's agent, or of the loaded policy before the
        first reset, and return the result.

        Raises:
            NotReset: There is an observation, but no session.
        """
        if self._session is not None:
            return (self._ask(Request("call", obs, kwargs=asdict(call))).info or {}).get("result")
        if obs is not None:
            raise NotReset(f"{call.member} before reset; reset first")
        return self._child.call_beside_acts(**asdict(call))["result"]

    def check_health(self) -> None:
        """Raise `PolicyUnavailable` if the child has ended, as it does if its policy is not
        healthy.
        """
        self._child.require_alive()

    def close(self) -> None:
        self._child.close()

    def _ask(self, request: Request) -> Reply:
        request.session = self._session or ""
        [reply] = self._child.call([request])
        if reply.error is not None:
            raise reply.error
        return reply

    def __getstate__(self) -> dict[str, Any]:
        """Export the session's state from the child, which removes the session there."""
        moved = None if self._session is None else self._ask(Request("export")).info
        return {"child": self._child, "moved": moved}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._child = state["child"]
        self._session = None
        if state["moved"] is not None:
            self._session = self._child.open_session()
            self._ask(Request("adopt", kwargs=state["moved"]))

    def __del__(self) -> None:
        session = getattr(self, "_session", None)  # missing if `__init__` did not run
        if session is not None:
            self._child.drop(session)


class _AbilityInChild:
    """An ability of the policy in a child process, with the members of its protocol."""

    def __init__(self, agent: ChildAgent, protocol: type) -> None:
        self._agent, self._protocol = agent, protocol

    def __getattr__(self, name: str) -> Any:
        if not is_method(self._protocol, name):
            return self._agent.use_ability(AbilityCall(name_of(self._protocol), name), None)

        def call(*args: Any, **kwargs: Any) -> Any:
            return self._agent.use_ability(
                *AbilityCall.from_arguments(self._protocol, name, args, kwargs)
            )

        return call


class ChildWeights(ModelWeights):
    """The versions of the weights in a child process, whose values stay there, on its GPU.

    This process decides which version acts, and the child makes versions while the policy acts.
    """

    def __init__(
        self,
        agent: ChildAgent,
        child: Child,
        busy: threading.Lock,
        digest: str,
        model: tuple[str, str],
    ) -> None:
        trained = child.loaded["trained"]
        super().__init__(agent, busy, trained.get("fingerprint", digest), model)
        self._child = child
        self._numbers = itertools.count(1)
        # Names of the versions in the child.
        self._names: WeakKeyDictionary[WeightsVersion, int] = WeakKeyDictionary()
        if "refusal" in trained:
            self._refusal = NotTrainable(trained["refusal"])
            return

        self._refusal = None
        self.gpus = tuple(trained["gpus"])
        self._name(self.newest, 0)
        self.newest.values = {
            name: ValueSpec(np.dtype("V2" if dtype == "bfloat16" else dtype), tuple(shape))
            for name, (dtype, shape) in trained["values"].items()
        }

    def make(
        self,
        number: int,
        newest: WeightsVersion,
        pushed: Mapping[str, Any] | SharedValues,
        options: PushOptions,
    ) -> WeightsVersion:
        """Make a version in the child from new values, which travel in a file in memory or are
        shared on the GPU.
        """
        name = next(self._numbers)
        if isinstance(pushed, SharedValues):
            shared = pushed.to_json()
            copied = pushed.others
        else:
            shared = None
            copied = pushed
            # The values are checked before any of them is copied.
            require_fit(newest.values or {}, pushed, partial=options.partial)

        make = {"base": self._names[newest], "number": number, "options": asdict(options)}
        with _memory_file() as file:
            write_values(file, {key: portable(value) for key, value in copied.items()})
            made = self._child.call_for_weights(
                name=name, values=_path(file), make=make, shared=shared
            )

        version = WeightsVersion(number, made["fingerprint"], newest.values)
        self._name(version, name)
        return version

    def use(self, version: WeightsVersion) -> None:
        """Make the policy act with a version."""
        if version is not self._live and version in self._names:
            self._live = None
            [reply] = self._child.call([Request("weights", kwargs={"use": self._names[version]})])
            if reply.error is not None:
                raise reply.error
            self._live = version

    def sleep(self, *, offload: bool) -> None:
        self._child.call_for_weights(offload=offload)

    def wake(self) -> None:
        self._child.call_for_weights()

    def portable_values(self, version: WeightsVersion) -> dict[str, Any]:
        with _memory_file() as file:
            self._child.call_for_weights(name=self._names[version], values=_path(file))
            return dict(read_values(file))

    def _name(self, version: WeightsVersion, name: int) -> None:
        self._names[version] = name
        finalize(version, self._child.drop, name).atexit = False


def _memory_file() -> BinaryIO:
    """Return a file in memory that is freed when it is closed, however the other process ends."""
    return os.fdopen(os.memfd_create("vlagents_weights"), "w+b")


def _path(file: BinaryIO) -> str:
    return f"/proc/{os.getpid()}/fd/{file.fileno()}"
