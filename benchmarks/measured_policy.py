"""A policy in this process, bare or behind a replica's batch queue, with timed calls; no Ray."""

from __future__ import annotations

import queue
import resource
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from typing_extensions import Self

from benchmarks.network import NetworkTimer
from vlagents_ray.contract import Contract
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.protocol.messages import PRIORITIES, PriorityName, Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.requests import IncomingMessage, PendingRequest

INSTRUCTION = "pick up the cube"
WARM = 2  # number of warm-up batches, which are not counted
_LATE_S = 600.0  # time limit of a batch, since the first batch may be compiled


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
    """A policy behind the batch queue of an engine, loaded from `__enter__` to `__exit__`.

    It is also measured without the queue, and the time of its network is also measured alone.
    """

    def __init__(
        self,
        agent: Agent,
        view: Callable[[Contract | None, int], Obs],
        *,
        max_size: int,
        patience: float = 0.0,
        batch_sizes: Sequence[int] = (),
    ) -> None:
        self.agent = agent
        settings = EngineSettings(
            max_batch_size=max_size, patience=patience, batch_sizes=batch_sizes
        )
        self.engine = Engine(agent, settings)
        self.load_s = 0.0
        self._view = view
        self._network = NetworkTimer()
        self._copies: AgentCopies

    def __enter__(self) -> Self:
        began = time.perf_counter()
        try:
            with self._network.loading():
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

    def bare(self, size: int, seconds: float) -> dict[str, float]:
        """Measure `act_batch` with full batches of this size, one after another, without the queue.

        Returns:
            "actions_per_s"; "batch_ms"; "network_ms": the time of the model's cores, 0 for a policy
            without cores.
        """
        batch = self.batch(range(size))
        times: list[float] = []
        networks: list[float] = []
        while len(times) < WARM + 1 or sum(times[WARM:]) < seconds:
            begun = time.perf_counter()
            networks.append(self._network.measure(batch) or 0.0)
            times.append(time.perf_counter() - begun)
        times, network_ms = times[WARM:], statistics.median(networks[WARM:])
        return {
            "actions_per_s": size * len(times) / sum(times),
            "batch_ms": statistics.median(times) * 1e3,
            "network_ms": network_ms,
        }

    def kernels(self, size: int) -> dict[str, list[dict[str, Any]]]:
        """Return the longest kernels of each of the model's cores in a call with this batch
        size.
        """
        batch = self.batch(range(size))
        batch()
        return self._network.kernels(batch)

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
