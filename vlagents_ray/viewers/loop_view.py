"""Shows a run of the control loop in viewers."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import numpy as np

from vlagents_ray.interface import INTERVENTION, PLANNED, SAFE, WANTED, Act, Obs
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

    def add(self, obs: Obs, act: Act, executed: np.ndarray | None, tick: int, work_s: float, stop: str = "") -> None:
        """Show a tick; never waits.

        Args:
            obs: The observation.
            act: What the agent answered.
            executed: The action that was applied, (D,) float32; None if none was.
            tick: The tick of the control loop.
            work_s: The time from the tick until the action was applied, s.
            stop: Why the robot is stopped, if it is.
        """
        if not any(viewer.has_room for viewer in self._viewers):
            for viewer in self._viewers:
                viewer.dropped += 1
            return
        info = act.info
        rows, note = info.get(PLANNED), stop or note_of(info)
        spells = {"safe": SAFE in info, "intervention": INTERVENTION in info, "stopped": bool(stop)}
        frame = ViewerFrame.of(
            obs,
            tick,
            executed=None if executed is None else np.array(executed),
            planned=info.get(WANTED) if rows is None else rows[info["row"]],
            chunk=None if rows is self._chunk else rows,
            numbers={**numbers_of(info), "work_ms": work_s * 1e3, **{name: float(on) for name, on in spells.items()}},
            note=note if note != self._note else "",
        )
        self._chunk, self._note = self._chunk if rows is None else rows, note
        for viewer in self._viewers:
            viewer.add(frame)
