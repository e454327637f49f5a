"""Shows a run of the control loop in viewers."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import numpy as np

from vlagents_ray.interface import PLANNED, SAFE, Act, Obs
from vlagents_ray.viewers.frame import ViewerFrame, note_of, numbers_of
from vlagents_ray.viewers.targets import dated_name
from vlagents_ray.viewers.viewer import EpisodeViewer


class LoopView:
    """Shows one run in each of some viewers; without one, it costs nothing."""

    def __init__(self, viewers: Sequence[EpisodeViewer]) -> None:
        """Show a run in `viewers`."""
        self._viewers = viewers
        self._chunk: np.ndarray | None = None  # the last one that was shown
        self._note = ""

    @contextlib.contextmanager
    def episode(self, instruction: str) -> Iterator[None]:
        """Show what is added within the context as one episode."""
        name = dated_name()
        with contextlib.ExitStack() as stack:
            for viewer in self._viewers:
                stack.enter_context(viewer.episode(name, instruction))
            yield

    def add(self, obs: Obs, act: Act, executed: np.ndarray, tick: int, work_s: float) -> None:
        """Show a tick; never waits.

        Args:
            obs: The observation.
            act: What the agent answered.
            executed: The action that was applied, (D,) float32.
            tick: The tick of the control loop.
            work_s: The time from the tick until the action was applied, s.
        """
        if not any(viewer.has_room for viewer in self._viewers):
            for viewer in self._viewers:
                viewer.dropped += 1
            return
        rows, note = act.info.get(PLANNED), note_of(act.info)
        frame = ViewerFrame.of(
            obs,
            tick,
            executed=np.array(executed),
            planned=None if rows is None else rows[act.info["row"]],
            chunk=None if rows is self._chunk else rows,
            numbers={**numbers_of(act.info), "work_ms": work_s * 1e3, "safe": float(SAFE in act.info)},
            note=note if note != self._note else "",
        )
        self._chunk, self._note = rows, note
        for viewer in self._viewers:
            viewer.add(frame)
