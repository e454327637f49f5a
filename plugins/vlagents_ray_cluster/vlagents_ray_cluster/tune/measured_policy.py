"""A policy in this process, behind a replica's batch queue, with timed calls; without Ray.

`python -m vlagents_ray_cluster.tune.measured_policy` loads and measures one variant of a policy for
`tuner`. It runs in the policy's Python environment, and therefore needs only the light install and
pydantic.

The first line of its input is `ProcessSettings`, as JSON. Each further line is a request,
{"measure": SESSIONS, "seconds": S, "priority": PRIORITY} or {"act": BATCH}. The answer is a line of
JSON. While the policy loads, lines {"step": …} describe the progress. {"failed": …} is an error.
"""

from __future__ import annotations

import json
import queue
import resource
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import Self

from vlagents_ray.contract import Contract
from vlagents_ray.errors import PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.wrapper import build_agent, unwrapped
from vlagents_ray.protocol.frames import decode_requests, encode_requests
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    PRIORITIES,
    Budget,
    PriorityName,
    Reply,
    Request,
)
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.models.agent_copies import AgentCopies
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout
from vlagents_ray.serve.requests import IncomingMessage, PendingRequest
from vlagents_ray.testing import random_observation
from vlagents_ray.validation import check_observation

INSTRUCTION = "pick up the cube"
WARM = 2  # number of warm-up batches, which are not counted
_LATE_S = 600.0  # time limit of a batch, since the first batch may be compiled
FRAMES = 8  # number of episodes whose first actions are compared
_TUNED = ("compile", "dtype", "quantization", "batch_sizes")  # settings of a policy


@dataclass(frozen=True, slots=True)
class QueuedTurn:
    """The figures of a number of sessions in one measurement."""

    actions_per_s: float
    mean_batch: float
    trips_ms: Sequence[float]  # round trip of each call, s


@dataclass(frozen=True, slots=True)
class _QueuedReplies:
    """The receiver of one session's replies, which are put into a queue with its index."""

    answers: queue.SimpleQueue[tuple[int, Reply]]
    index: int

    def deliver(self, message: IncomingMessage) -> None:
        """Put the only reply of a message into the queue."""
        [reply] = message.replies
        self.answers.put((self.index, reply))


class MeasuredPolicy:
    """A policy behind the batch queue of an engine, loaded from `__enter__` to `__exit__`."""

    def __init__(
        self,
        agent: Agent,
        view: Callable[[Contract | None, int], Obs],
        *,
        max_size: int,
        patience: float = 0.0,
        batch_sizes: Sequence[int] = (),
        on_step: Callable[[str], None] | None = None,
    ) -> None:
        self.agent = agent
        settings = EngineSettings(
            max_batch_size=max_size, patience=patience, batch_sizes=batch_sizes
        )
        self.engine = Engine(agent, settings, on_step=on_step)
        self.load_s = 0.0
        self._view = view
        self._copies: AgentCopies

    def __enter__(self) -> Self:
        began = time.perf_counter()
        try:
            self.engine.start()
        except BaseException:
            self.engine.close()
            raise
        self.load_s = time.perf_counter() - began
        self._copies = AgentCopies(self.agent)
        return self

    def __exit__(self, *exc: object) -> None:
        self.engine.close()

    def actions(self, size: int, count: int) -> list[np.ndarray]:
        """Compute the first actions of episodes, each of which has its observation and seed.

        Args:
            size: The batch size.
            count: The number of episodes, which are numbered from 0. If `size` does not divide it,
                the last batch continues with episode 0.

        Returns:
            At least `count` actions, (D,) or (H, D) float32; the action at i belongs to episode i
            modulo `count`.
        """
        actions: list[np.ndarray] = []
        while len(actions) < count:
            episodes = [i % count for i in range(len(actions), len(actions) + size)]
            actions += [act.action for act in self.batch(episodes)()]
        return actions

    def batch(self, episodes: Sequence[int]) -> Callable[[], list[Act]]:
        """Return a function that acts once with new sessions of these episodes, in one batch."""
        views = [self._view(self.engine.contract, i) for i in episodes]
        sessions = [self._copies.make() for _ in episodes]
        for session, view, i in zip(sessions, views, episodes, strict=True):
            session.reset(view, INSTRUCTION, seed=i)

        def act() -> list[Act]:
            acts = []
            for result in self.agent.act_batch(views, sessions):
                if isinstance(result, Exception):
                    raise result
                acts.append(result)
            return acts

        return act

    def queued(self, size: int, seconds: float, priority: PriorityName) -> QueuedTurn:
        """Measure sessions that send their next request as soon as the last request is answered.

        Args:
            size: The number of sessions.
            seconds: The duration of the measurement after the warm-up, s.
            priority: The priority of the requests.

        Raises:
            VLAgentsError: The error of a request.
        """
        views = [self._view(self.engine.contract, i) for i in range(size)]
        answers: queue.SimpleQueue[tuple[int, Reply]] = queue.SimpleQueue()
        receivers = [_QueuedReplies(answers, i) for i in range(size)]
        sent_at = [0.0] * size

        def send(i: int, op: Any, **fields: Any) -> None:
            sent_at[i] = time.perf_counter()
            request = Request(op, views[i], priority=priority, **fields)
            message = IncomingMessage("bench", op, priority)
            message.expect(1, receivers[i])
            pending = PendingRequest(f"bench-{i}", request, message, PRIORITIES[priority])
            self.engine.intake.submit([pending])

        def receive() -> tuple[int, Reply, float]:
            i, reply = answers.get(timeout=_LATE_S)
            if reply.error is not None:
                raise reply.error
            return i, reply, time.perf_counter()

        for i in range(size):
            send(i, "reset", instruction=INSTRUCTION, kwargs={"seed": i})
        for _ in range(size):
            receive()

        for i in range(size):
            send(i, "act")
        calls: list[tuple[float, float, float]] = []  # end (s), round trip (s), batch size
        in_flight = size
        warm_up = WARM * size  # number of calls that are not counted
        while in_flight:
            i, reply, now = receive()
            calls.append((now, now - sent_at[i], reply.timing["batch_size"]))
            in_flight -= 1
            if len(calls) <= warm_up or now - calls[warm_up][0] < seconds:
                in_flight += 1
                send(i, "act")

        for i in range(size):
            send(i, "close")
            receive()

        # Each batch is counted once for each of its calls. The mean size of the batches is
        # therefore the harmonic mean over the calls.
        calls = calls[warm_up:]
        mean_batch = len(calls) / sum(1 / call[2] for call in calls)
        return QueuedTurn(rate_of([calls]), mean_batch, [call[1] * 1e3 for call in calls])


def rate_of(calls: Sequence[Sequence[tuple[float, ...]]]) -> float:
    """Return actions per second: the slope of the line through the ends of all calls.

    Actions are computed in batches, so a count within a fixed time could be wrong by a batch.

    Args:
        calls: The calls of each client; the first value of a call is its end, s.

    Returns:
        The rate; 0 for fewer than two calls.
    """
    ends_of_calls: list[float] = []
    for calls_of_client in calls:
        ends_of_calls += [call[0] for call in calls_of_client]

    ends = np.sort(ends_of_calls)
    if len(ends) < 2 or ends[0] == ends[-1]:
        return 0.0
    return float(np.polyfit(ends - ends[0], np.arange(len(ends)), 1)[0])


def cuda() -> Any:
    """Return the module `torch.cuda` if this process uses CUDA through torch, otherwise None."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized():
        return torch.cuda
    return None


def jax_device() -> Any:
    """Return JAX's first device if this process uses JAX on an accelerator, otherwise None."""
    jax = sys.modules.get("jax")
    device = None if jax is None else jax.local_devices()[0]
    return None if device is None or device.platform == "cpu" else device


def forget_peak() -> None:
    """Reset `peak_mib`, if the accelerator supports it."""
    torch_cuda = cuda()
    if torch_cuda is not None:
        torch_cuda.reset_peak_memory_stats()


def peak_mib() -> float:
    """Return the peak memory in use, MiB.

    Returns:
        The memory of the accelerator, with torch since the last `forget_peak`; without an
        accelerator, the memory of this process.
    """
    torch_cuda = cuda()
    if torch_cuda is not None:
        return float(torch_cuda.max_memory_allocated()) / 2**20

    device = jax_device()
    if device is not None:
        return float((device.memory_stats() or {}).get("peak_bytes_in_use", 0)) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def device_name() -> str:
    """Return the name of the policy's accelerator, or "cpu"."""
    torch_cuda = cuda()
    if torch_cuda is not None:
        return str(torch_cuda.get_device_name())

    device = jax_device()
    return "cpu" if device is None else str(device.device_kind)


@dataclass(frozen=True, slots=True)
class ProcessSettings:
    """The variant to measure; the first line of the process's input."""

    policy: str
    config: dict[str, Any]
    wrappers: Sequence[Any]
    max_size: int  # maximum number of sessions to be measured
    patience: float  # the deployment's `batch.patience`
    batch_sizes: Sequence[int]  # the deployment's `batch.sizes`, or none
    frames: str | None  # a file of `save_observations`; None selects random observations
    side: int  # size of random images for which the contract defines none, px
    dims: Mapping[str, int]  # sizes by name in the state, where the contract defines none


def save_observations(observations: Sequence[Obs], file: Path) -> None:
    """Write observations as a frame of requests, for `load_observations`."""
    file.write_bytes(encode_requests([Request("act", obs) for obs in observations]))


def load_observations(file: Path) -> list[Obs]:
    """Read the observations written by `save_observations`."""
    data = file.read_bytes()
    limits = replace(DEFAULT_LIMITS, body_bytes=len(data))
    requests, error_replies = decode_requests(data, Budget(limits))
    for reply in error_replies.values():
        raise PolicyFailed(f"{file}: an observation cannot be sent to a server") from reply.error
    return [request.obs for request in requests if request.obs is not None]


def main() -> None:
    """Load the policy and answer requests until the input ends."""
    die_with_parent()
    out = own_stdout()

    def answer(message: Mapping[str, Any]) -> None:
        print(json.dumps(message), file=out, flush=True)

    try:
        _serve(ProcessSettings(**json.loads(sys.stdin.readline())), answer)
    except Exception as error:  # noqa: BLE001 - a policy may raise any error
        answer({"failed": _sentence(error)})
        sys.exit(1)


def _serve(settings: ProcessSettings, answer: Callable[[Mapping[str, Any]], None]) -> None:
    """Load the policy, report it, and answer requests until the input ends."""
    agent: Agent = build_agent(settings.policy, settings.config, settings.wrappers)
    recorded = [] if settings.frames is None else load_observations(Path(settings.frames))

    def view(contract: Contract | None, i: int) -> Obs:
        if not recorded:
            return random_observation(contract, i, image_size=settings.side, dims=settings.dims)
        check_observation(recorded[i % len(recorded)], contract)
        return recorded[i % len(recorded)]

    measured = MeasuredPolicy(
        agent,
        view,
        max_size=settings.max_size,
        patience=settings.patience,
        batch_sizes=settings.batch_sizes,
        on_step=lambda step: answer({"step": step}),
    )
    with measured:
        answer(_report(measured, getattr(unwrapped(agent), "config", None)))
        for line in sys.stdin:
            try:
                result = _result(measured, json.loads(line))
            except Exception as error:  # noqa: BLE001 - as above; smaller batches may still work
                result = {"failed": _sentence(error)}
            answer(result)


def _report(measured: MeasuredPolicy, config: Any) -> dict[str, Any]:
    """Return what the tuner needs to choose variants: the device, the settings and their values.

    Args:
        measured: The loaded policy.
        config: The policy's config; None if it has none.
    """
    settings = {}
    for name in _TUNED:
        if name in getattr(type(config), "model_fields", {}):
            settings[name] = getattr(config, name)

    # Types that the accelerator computes without emulation, and the values of `compile`.
    dtypes = [] if jax_device() is None else ["bfloat16"]
    modes: list[Any] = [False, True]
    torch_cuda = cuda()
    if torch_cuda is not None:
        dtypes = ["bfloat16" if torch_cuda.get_device_capability() >= (8, 0) else "float16"]
        modes = [False, "graphs", True]
    return {
        "device": device_name(),
        "load_s": measured.load_s,
        "uncompiled": measured.engine.models.uncompiled,
        "settings": settings,
        "dtypes": dtypes,
        "modes": modes,
    }


def _result(measured: MeasuredPolicy, request: Mapping[str, Any]) -> dict[str, Any]:
    """Return the answer to a request of the tuner."""
    if "act" in request:
        actions = measured.actions(request["act"], FRAMES)
        return {"actions": [action.tolist() for action in actions]}

    forget_peak()
    turn = measured.queued(request["measure"], request["seconds"], request["priority"])
    return {
        "actions_per_s": turn.actions_per_s,
        "trips_ms": [round(trip, 4) for trip in turn.trips_ms],
        "peak_mib": peak_mib(),
    }


def _sentence(error: BaseException) -> str:
    """Return an error in one line, with the cause of an error in the policy's code."""
    cause = error
    if isinstance(error, PolicyFailed) and error.__cause__ is not None:
        cause = error.__cause__
    return f"{type(cause).__name__}: {' '.join(str(cause).split())}"


if __name__ == "__main__":
    main()
