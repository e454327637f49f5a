"""Preparation of observations on other threads than the policy's, so that the next batch is ready
when one ends.

A batch does not wait for preparations that have not begun: the policy's thread runs those itself,
beginning with the last one. So a robot whose request arrives last does not wait for the
preparations of earlier simulations.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

from vlagents_ray.images import thread_map
from vlagents_ray.interface import Agent, Obs

_THREADS = 4  # maximum number of threads; images are resized without Python's lock


class Preparation(NamedTuple):
    """The call of `Agent.prepare` for one observation."""

    agent: Agent
    obs: Obs
    future: Future[Any]


class Preparations:
    """The threads of a replica that prepare observations."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(min(_THREADS, thread_map.allowed()), "prepare")

    def begin(self, agent: Agent | None, obs: Obs | None) -> Preparation | None:
        """Begin to prepare an observation for a session's agent; None if there is nothing to do."""
        if agent is None or obs is None or type(agent).prepare is Agent.prepare:
            return None
        try:
            return Preparation(agent, obs, self._threads.submit(agent.prepare, obs))
        except RuntimeError:  # the threads have ended
            return None

    @staticmethod
    def finish(
        preparations: Sequence[tuple[Preparation | None, Agent | None]],
    ) -> dict[int, Exception]:
        """Finish the preparations of a batch; return their errors by their indices in the batch.

        Called on the policy's thread.
        """
        errors: dict[int, Exception] = {}

        def finish_at(index: int, *, begun: bool) -> None:
            """Finish one preparation, on this thread unless another one has begun it."""
            preparation, agent = preparations[index]
            if preparation is None or agent is not preparation.agent:  # the session has been reset
                return
            obs, future = preparation.obs, preparation.future
            try:
                obs.prepared = future.result() if begun else preparation.agent.prepare(obs)
            except Exception as error:  # noqa: BLE001 - fails the request of that observation
                errors[index] = error

        begun = []  # indices of the preparations that run on other threads, or have ended
        for index, (preparation, _) in reversed(list(enumerate(preparations))):
            if preparation is not None and preparation.future.cancel():
                finish_at(index, begun=False)
            elif preparation is not None:
                begun.append(index)

        for index in begun:
            finish_at(index, begun=True)
        return errors

    def close(self) -> None:
        """End the threads after the preparations that have begun."""
        self._threads.shutdown(wait=False, cancel_futures=True)
