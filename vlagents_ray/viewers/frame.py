"""One step of an episode, as viewers show it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.interface import AGE, CAPTURED, SAFE, SILENT, Obs


@dataclass(frozen=True, slots=True)
class ViewerFrame:
    """An observation, what was planned from it and executed after it. The caller does not change its arrays later."""

    tick: int  # of the episode
    time: float  # s since 1970, of the observation
    cameras: Mapping[str, np.ndarray] = field(default_factory=dict)  # (H, W, 3) uint8 RGB
    files: Mapping[str, bytes] = field(default_factory=dict)  # JPEG or PNG files of cameras that are not in `cameras`
    state: Mapping[str, np.ndarray] = field(default_factory=dict)  # (D,) float32; the gripper is a part
    executed: np.ndarray | None = None  # (D,) float32
    planned: np.ndarray | None = None  # (D,) float32: what the newest chunk says of this tick
    chunk: np.ndarray | None = None  # (H, D) float32, where a new one begins
    numbers: Mapping[str, float] = field(default_factory=dict)  # times and whatever else is a number, by name
    note: str = ""  # what a person should read, such as why the action is a safe one

    @classmethod
    def of(cls, obs: Obs, tick: int, **what: Any) -> ViewerFrame:
        """Make a frame of an observation.

        Args:
            obs: The observation, whose arrays are copied.
            tick: The tick of the episode.
            what: Further fields.

        Returns:
            The frame, with the time of `info["captured_at"]` if the observation states it, else now.
        """
        state = {name: np.array(part) for name, part in obs.state.items()}
        if obs.gripper is not None:
            state["gripper"] = np.array([obs.gripper], np.float32)
        cameras = {name: np.array(image) for name, image in obs.cameras.items()}
        return cls(tick, **{"time": obs.info.get(CAPTURED, time.time()), **what}, cameras=cameras, state=state)

    def images(self) -> dict[str, bytes]:
        """Return a JPEG or PNG file for each camera."""
        return {**self.files, **{name: encode_jpeg(image) for name, image in self.cameras.items()}}


def numbers_of(info: Mapping[str, Any]) -> dict[str, float]:
    """Return what the info of an `Act` says in numbers that viewers show: its timing, and that of a chunk player."""
    timing = info.get("timing") or {}
    return {**timing, **{name: float(info[name]) for name in (AGE, SILENT) if name in info}}


def note_of(info: Mapping[str, Any]) -> str:
    """Return why the action of an `Act` is a safe one; "" if it is the policy's."""
    return str(info.get(SAFE, ""))
