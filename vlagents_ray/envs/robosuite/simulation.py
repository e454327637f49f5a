"""What robosuite's environments share: cameras that render only what is looked at, and seeds."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np


class CameraRenderer:
    """Renders the cameras while it is `open`; otherwise they show black and cost nothing.

    robosuite renders each camera for every observation, 14 times from the beginning of a reset to the policy's
    first observation. It samples a step's observation, images included, after the first 2 ms of the step's 50;
    the views for recordings are of the same moment.
    """

    def __init__(self, domain: Any, record_size: tuple[int, int] | None) -> None:
        self.open = True
        self.views: dict[str, np.ndarray] = {}
        self._domain = domain
        self._record_size = record_size
        self._own = domain._create_camera_sensors
        domain._create_camera_sensors = self._sensors  # called again in each reset

    def make_current(self) -> None:
        """Render in this simulator's OpenGL context: the process may have others."""
        sim = self._domain.sim
        if sim is not None and sim._render_context_offscreen is not None:  # after a failed reset there is none
            sim._render_context_offscreen.gl_ctx.make_current()

    def _sensors(self, cam_name: str, cam_w: int, cam_h: int, **rest: Any) -> tuple[list[Any], list[str]]:
        [own], names = self._own(cam_name, cam_w=cam_w, cam_h=cam_h, **rest)
        return [self._switched(own, cam_name, (cam_h, cam_w))], names

    def _switched(self, own: Callable[[Any], np.ndarray], camera: str, size: tuple[int, int]) -> Callable[[Any], Any]:
        @functools.wraps(own)  # keeps robosuite's attributes
        def look(cache: Any) -> np.ndarray:
            if not self.open:
                return np.zeros((*size, 3), np.uint8)
            self.make_current()
            if self._record_size is not None:
                height, width = self._record_size
                view = self._domain.sim.render(camera_name=camera, height=height, width=width)
                self.views = self.views | {camera: view}
            return own(cache)

        return look


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """robosuite 1.4 and LIBERO draw from numpy's global generator, whose state is restored."""
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002
