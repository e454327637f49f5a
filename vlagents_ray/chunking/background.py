"""Calls to a policy from a background thread, one request at a time."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Generator
from dataclasses import replace

from vlagents_ray.errors import PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs

_CLOSE_S = 2.0


def parts_of(agent: Agent, obs: Obs) -> Generator[Act, None, None]:
    """Yield the parts of the policy's chunk, if it gives parts, or the whole chunk.

    Raises:
        PolicyFailed: The policy ends without a last part.
    """
    if agent.act_parts is None:
        yield replace(agent.act(obs), more=False)
        return
    stream = agent.act_stream(obs)
    for part in stream:
        if not part.more:
            stream.close()  # so that nothing of it is left to run when the caller has the last part
            yield part
            return
        yield part
    raise PolicyFailed("act_stream: it ended without a last part, i.e. one without `more`")


class AsyncCaller:
    """A thread that calls `agent.act` or `act_stream`, so that the caller's own thread never waits for it.

    Nothing else may use the agent during a request; `settle` waits for its end.
    """

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._changed = threading.Condition()
        self._job: Obs | None = None
        self._answers: deque[Act | Exception] = deque()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="vlagents-ray-caller", daemon=True)
        self._thread.start()

    @property
    def idle(self) -> bool:
        """Whether there is neither a request in progress nor an answer to be taken."""
        return self._job is None and not self._answers

    def ask(self, obs: Obs) -> None:
        """Begin a request, only while `idle`. The caller must not change `obs` afterwards."""
        with self._changed:
            self._job = obs
            self._changed.notify_all()

    def take(self, wait_s: float = 0.0) -> Act | Exception | None:
        """Return the policy's answer, its next part, or its error, if one comes within `wait_s` seconds; else None."""
        if not self._answers and wait_s > 0:
            with self._changed:
                self._changed.wait_for(lambda: self._answers, wait_s)
        with self._changed:
            return self._answers.popleft() if self._answers else None

    def settle(self) -> None:
        """Wait for the end of the request in progress, however long that takes, and drop its answer."""
        with self._changed:
            self._changed.wait_for(lambda: self._job is None)
            self._answers.clear()

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
                for part in parts_of(self._agent, job):
                    self._note(part, last=not part.more)
            except Exception as error:  # noqa: BLE001 - raised or reported where the answer is taken
                self._note(error, last=True)
        self._agent.close()

    def _note(self, answer: Act | Exception, *, last: bool) -> None:
        with self._changed:
            self._answers.append(answer)
            if last:
                self._job = None  # after the answer: `idle` takes no lock
            self._changed.notify_all()
