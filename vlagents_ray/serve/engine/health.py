"""Whether the policy of an engine can act, and the reason if it cannot."""

from __future__ import annotations

import logging
import threading
from typing import NamedTuple

from vlagents_ray.errors import PolicyFailed, PolicyUnavailable, VLAgentsError
from vlagents_ray.serve.engine.metrics_buffer import MetricsBuffer
from vlagents_ray.serve.engine.responses import raised_at
from vlagents_ray.serve.models.served_model import ServedModel
from vlagents_ray.serve.queue.call_limits import PolicyCall, PolicyCalls

logger = logging.getLogger(__name__)

# The beginning of the reason why a policy did not load, by which the process that starts the server
# finds it in Serve's messages.
NOT_LOADED = "the policy did not load"


class HangingCall(NamedTuple):
    """A call of the policy that exceeds its time limit."""

    description: str
    refusal: PolicyUnavailable  # error for requests that the policy has not received


class Health:
    """Whether the policy can act. Thread-safe.

    Several reasons why it cannot act may exist at once. Clients get the first of these: the policy
    failed to load, the replica stops, a call hangs, the policy is loading, its thread has ended.
    """

    def __init__(self, model: ServedModel, calls: PolicyCalls, stats: MetricsBuffer) -> None:
        self._model = model
        self._calls = calls
        self._stats = stats

        self._loading_error = model.loading()
        self._lock = threading.Lock()  # held while one of the following fields is set
        self._loading = True
        # Reason why the policy did not load, for clients, which may find another replica, and for
        # the operator.
        self._load_failure: PolicyUnavailable | None = None
        self._full_load_failure: PolicyFailed | None = None
        self._stopping: PolicyUnavailable | None = None
        self._hung: PolicyCall | None = None  # overdue call, which `find_hanging_call` has detected
        self._hanging: PolicyUnavailable | None = None
        self.alive = False  # whether a thread takes batches from the queue
        # The first reason, which is updated after each change. Requests read only this field.
        self._unready: VLAgentsError | None = self._loading_error

    def begin_thread(self) -> None:
        """Record that a thread loads the policy, and will take batches."""
        with self._lock:
            self.alive = True
            self._update()

    def end_thread(self) -> None:
        """Record that no thread takes batches any more."""
        with self._lock:
            self.alive = False
            self._update()

    def begin_loading(self) -> None:
        """Record that the policy is loaded again, which may follow a failed attempt."""
        with self._lock:
            self._loading = True
            self._load_failure = self._full_load_failure = None
            self._update()

    def finish_loading(self) -> None:
        """Record that the policy is loaded."""
        with self._lock:
            self._loading = False
            self._update()

    def fail_loading(self, error: Exception) -> PolicyFailed:
        """Record that the policy did not load; return the full reason, for the operator."""
        failed = f"{NOT_LOADED}: {type(error).__name__}"
        with self._lock:
            self._load_failure = PolicyUnavailable(f"{failed}; the server's log says why")
            self._full_load_failure = PolicyFailed(f"{failed}: {error}{raised_at(error)}")
            self._update()
            return self._full_load_failure

    def stop(self) -> PolicyUnavailable:
        """Record that the replica stops; return the error for clients."""
        with self._lock:
            self._stopping = PolicyUnavailable("the replica is stopping; connect again")
            self._update()
            return self._stopping

    def find_hanging_call(self) -> HangingCall | None:
        """Return the call of the policy that exceeds its time limit. From then on, no request is
        accepted until the call returns.
        """
        call = self._calls.overdue()
        if call is None:
            self._record_return()
            return None

        description = call.describe()
        refusal = PolicyUnavailable(f"{description}; the session begins again at another replica")
        with self._lock:
            is_new = self._hung is None
            if is_new:
                self._hung = call
                self._hanging = refusal
                self._update()
        if is_new:
            logger.error(
                "%s. This replica is unhealthy until the call returns. Thread of the call:\n%s",
                description,
                call.stack(),
            )
            self._stats.hung(call.op)
        return HangingCall(description, refusal)

    def _record_return(self) -> None:
        with self._lock:
            returned, self._hung, self._hanging = self._hung, None, None
            if returned is not None:
                self._update()
        if returned is not None:
            logger.warning("the policy has returned from %r after all", returned.op)

    def _update(self) -> None:
        """Choose the first reason; the caller holds the lock."""
        self._unready = self._load_failure or self._stopping or self._hanging
        if self._unready is None and self._loading:
            self._unready = self._loading_error
        if self._unready is None and not self.alive:
            self._unready = PolicyFailed("the policy's thread has ended")

    @property
    def ready(self) -> bool:
        """Whether the policy is loaded and healthy."""
        try:
            self.check()
        except Exception:  # noqa: BLE001 - a policy's `check_health` may raise any error
            return False
        return True

    def require_ready(self) -> None:
        """Raise `PolicyUnavailable` while the policy loads, or if it did not load; raise
        `PolicyFailed` if its thread ended.
        """
        unready = self._unready
        if unready is self._loading_error:
            raise self._model.loading()  # with the current step of loading
        if unready is not None:
            raise unready
        if self._calls.broken is not None:
            self._calls.require_device()

    def check(self) -> None:
        """Raise an error with the full reason if the policy cannot act, including errors of the
        agents' own health checks.

        The error is meant for the operator, and for the controller that replaces unhealthy
        replicas.
        """
        if self._full_load_failure is not None:
            raise self._full_load_failure
        overdue = self._calls.overdue()
        if overdue is not None:
            raise PolicyUnavailable(overdue.describe())
        self.require_ready()
        self._calls.check_health()
        self._model.check_health()
