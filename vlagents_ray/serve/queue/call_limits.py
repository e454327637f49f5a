"""Running calls of a policy, and whether one of them exceeds its time limit.

A deadlocked driver, or a policy that waits for an event that never occurs, keeps its thread alive.
Only the time since the call began distinguishes such a policy from a policy that is computing. A
policy that compiles takes long for its first few calls, so these calls and loading have longer
limits.
"""

from __future__ import annotations

import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from vlagents_ray.errors import PolicyFailed, PolicyUnavailable, VLAgentsError
from vlagents_ray.policies.base.accelerator import is_device_failure

# Number of calls of a kind that may take long: the first call compiles, and the second call
# compiles for dynamic sizes.
_WARM_UP_CALLS = 2
_MULTIPLE = 10  # limit of a call, as a multiple of the longest call of its kind so far
LOAD = "load"
# Number of consecutive batches without any action, after which a replica is replaced.
FAILED_BATCHES = 20


@dataclass(frozen=True, slots=True)
class CallLimits:
    """Time limits for calls of the policy, s."""

    # Limit of a call, or ten times the duration of the longest call of its kind so far, whichever
    # is longer.
    act_s: float = 60.0
    warm_up_s: float = 600.0  # limit of each of the first two calls of a kind
    load_s: float = 3600.0  # limit for loading a checkpoint


class PolicyCall:
    """Context manager around the calls of one kind, on one thread at a time. It measures the
    durations of the calls.
    """

    __slots__ = ("_calls", "_count", "_longest_s", "_process", "_thread", "began", "ended", "op")

    def __init__(self, calls: PolicyCalls, op: str) -> None:
        self.op, self._calls = op, calls
        # Times of the last call, s of `PolicyCalls.clock`; for the calling thread only.
        self.began = self.ended = 0.0
        self._thread = self._process = 0
        self._count = 0
        # Duration of the longest call, s. Among the warm-up calls, only the shortest counts.
        self._longest_s = 0.0

    def __enter__(self) -> PolicyCall:
        self._thread, self._process = threading.get_ident(), os.getpid()
        self.began = self._calls.clock()
        self._calls.under_way.add(self)
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if os.getpid() != self._process:
            # The policy forked this process during the call. The process shares the clients'
            # sockets, so it must end.
            message = f"a process that the policy forked in {self.op!r} has returned; it is ended\n"
            os.write(2, message.encode())
            os._exit(1)
        if error is not None:
            self._calls.record_error(error)
        self._calls.under_way.discard(self)
        self.ended = self._calls.clock()
        took_s = self.ended - self.began
        self._count += 1
        if self._count == _WARM_UP_CALLS:
            self._longest_s = min(self._longest_s, took_s)
        elif took_s > self._longest_s:
            self._longest_s = took_s

    @property
    def limit_s(self) -> float:
        """Time limit of the running call or, if no call is running, of the next call, s."""
        limits = self._calls.limits
        if self.op == LOAD:
            return limits.load_s
        if self._count < _WARM_UP_CALLS:
            return max(limits.act_s, limits.warm_up_s)
        return max(limits.act_s, _MULTIPLE * self._longest_s)

    @property
    def lasted_s(self) -> float:
        """Time since the running call began, s."""
        return self._calls.clock() - self.began

    def describe(self) -> str:
        """Return a sentence with the operation, the time that it has taken so far, and its
        limit.
        """
        return (
            f"the policy has not returned from {self.op!r} for {self.lasted_s:.3g} s; its "
            f"limit is {self.limit_s:.3g} s"
        )

    def stack(self) -> str:
        """Return the stack trace of the calling thread; empty if that thread has ended."""
        frame = sys._current_frames().get(self._thread)
        return "" if frame is None else "".join(traceback.format_stack(frame))


class PolicyCalls:
    """The running calls into all policies of a replica, on all threads."""

    def __init__(
        self, limits: CallLimits | None = None, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self.limits = limits or CallLimits()
        self.clock = clock
        self.under_way: set[PolicyCall] = set()
        self.failed_batches = 0  # number of consecutive failed batches
        # Error of an accelerator after which every call fails; None if there was none.
        self.broken: BaseException | None = None

    def record_error(self, error: BaseException) -> None:
        """Record an error of the policy if it reports a failed accelerator."""
        if self.broken is None and is_device_failure(error):
            self.broken = error

    def record_batch(self, results: Sequence[object]) -> None:
        """Count consecutive batches in which every row failed with an error of the policy; errors
        of requests do not count.
        """
        errors = [result for result in results if isinstance(result, Exception)]
        for error in errors:
            self.record_error(error)
        if len(errors) < len(results):
            self.failed_batches = 0
        elif all(
            isinstance(error, PolicyFailed) or not isinstance(error, VLAgentsError)
            for error in errors
        ):
            self.failed_batches += 1

    def require_device(self) -> None:
        """Raise `PolicyUnavailable` if the accelerator failed, so that clients restart their
        episodes at another replica.
        """
        if self.broken is not None:
            error = f"{type(self.broken).__name__}: {str(self.broken).partition(chr(10))[0]}"
            raise PolicyUnavailable(
                f"the policy's accelerator failed ({error}); this replica is replaced, and the "
                "session begins again at another one"
            ) from self.broken

    def check_health(self) -> None:
        """Raise an error if the accelerator failed, or if all of the last `FAILED_BATCHES` batches
        failed.
        """
        self.require_device()
        if self.failed_batches >= FAILED_BATCHES:
            raise PolicyFailed(
                f"the last {self.failed_batches} batches failed as a whole; see the server's log"
            )

    def overdue(self) -> PolicyCall | None:
        """Return a running call that has exceeded its limit, or None."""
        return next((call for call in tuple(self.under_way) if call.lasted_s > call.limit_s), None)
