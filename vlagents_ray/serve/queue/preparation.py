"""Preparation of observations on threads other than the policy's, so that the next batch is ready
when a batch ends.

A batch does not wait for preparations that have not begun: the policy's thread runs them itself,
beginning with the last one. A robot whose request arrives last therefore does not wait for the
preparations of earlier simulations.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

from vlagents_ray.abilities import Prepares
from vlagents_ray.images import thread_map
from vlagents_ray.interface import Obs
from vlagents_ray.policies.act_stream import ActStream

_THREADS = 4  # maximum number of threads; images are resized without Python's lock


class Preparation(NamedTuple):
    """The call of `Prepares.prepare` for one observation."""

    prepares: Prepares
    obs: Obs
    future: Future[Any]


class Preparations:
    """The threads of a replica that prepare observations."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(min(_THREADS, thread_map.allowed()), "prepare")

    def begin(
        self, prepares: Prepares | None, obs: Obs | None, acts: ActStream | None = None
    ) -> Preparation | None:
        """Begin to prepare an observation.

        Args:
            prepares: The ability of the session's agent; None if it prepares nothing.
            obs: The observation.
            acts: The stream of the agent's calls; None without a GPU.

        Returns:
            The preparation; None if there is nothing to do.
        """
        if prepares is None or obs is None:
            return None
        try:
            if acts is None:
                future = self._threads.submit(prepares.prepare, obs)
            else:
                future = self._threads.submit(acts.run, prepares.prepare, obs)
            return Preparation(prepares, obs, future)
        except RuntimeError:  # the threads have ended
            return None

    @staticmethod
    def finish(
        preparations: Sequence[tuple[Preparation | None, Prepares | None]],
    ) -> dict[int, Exception]:
        """Finish the preparations of a batch; called on the policy's thread.

        Args:
            preparations: For each request, the result of `begin`, and the current ability of the
                session's agent. That ability differs from the one at `begin` if the session has
                been reset since.

        Returns:
            The errors of preparations by their indices in the batch.
        """
        errors: dict[int, Exception] = {}

        def finish_at(index: int, *, begun: bool) -> None:
            """Finish one preparation, on this thread unless another thread has begun it."""
            preparation, prepares = preparations[index]
            # The session may have been reset.
            if preparation is None or prepares is not preparation.prepares:
                return
            obs, future = preparation.obs, preparation.future
            try:
                obs.prepared = future.result() if begun else preparation.prepares.prepare(obs)
            except Exception as error:  # noqa: BLE001 - fails the request of that observation
                errors[index] = error

        begun = []  # indices of the preparations that run on other threads or have ended
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
