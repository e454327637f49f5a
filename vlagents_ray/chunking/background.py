"""Calls to a policy from a background thread, one request at a time."""

from __future__ import annotations

import threading

from vlagents_ray.interface import Act, Agent, Obs

_CLOSE_S = 2.0


class AsyncCaller:
    """A thread that calls `agent.act`, so that the caller's own thread never waits for it.

    Nothing else may use the agent during a request; `settle` waits for its end.
    """

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._changed = threading.Condition()
        self._job: Obs | None = None
        self._answer: Act | Exception | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="vlagents-ray-caller", daemon=True)
        self._thread.start()

    @property
    def idle(self) -> bool:
        """Whether there is neither a request in progress nor an answer to be taken."""
        return self._job is None and self._answer is None

    def ask(self, obs: Obs) -> None:
        """Begin a request, only while `idle`. The caller must not change `obs` afterwards."""
        with self._changed:
            self._job = obs
            self._changed.notify_all()

    def take(self, wait_s: float = 0.0) -> Act | Exception | None:
        """Return the policy's answer or its error, if it comes within `wait_s` seconds; else None."""
        if self._answer is None and wait_s > 0:
            with self._changed:
                self._changed.wait_for(lambda: self._answer is not None, wait_s)
        with self._changed:
            answer, self._answer = self._answer, None
        return answer

    def settle(self) -> None:
        """Wait for the end of the request in progress, however long that takes, and drop its answer."""
        with self._changed:
            self._changed.wait_for(lambda: self._job is None)
            self._answer = None

    def close(self) -> None:
        """Close the agent as soon as its request is over; wait for that for two seconds at most."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._job is not None or self._closing)
                job = self._job
            if job is None:
                break
            try:
                answer: Act | Exception = self._agent.act(job)
            except Exception as error:  # noqa: BLE001 - raised or reported where the answer is taken
                answer = error
            with self._changed:
                self._answer = answer
                self._job = None  # after the answer: `idle` takes no lock
                self._changed.notify_all()
        self._agent.close()
