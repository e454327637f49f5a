"""The error of a policy against what was recorded, by joint and by step of the horizon."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

_WORST = 10


@dataclass
class ErrorTable:
    """Sums over the frames so far, for each step of the horizon (H) and each number of an action (D)."""

    dim: int
    absolute: np.ndarray = field(init=False)  # (H, D), of the errors' absolute values
    square: np.ndarray = field(init=False)  # (H, D), of their squares
    largest: np.ndarray = field(init=False)  # (H, D), of their absolute values
    frames: np.ndarray = field(init=False)  # (H,)

    def __post_init__(self) -> None:
        self.absolute, self.square, self.largest = (np.zeros((0, self.dim)) for _ in range(3))
        self.frames = np.zeros(0, np.int64)

    def add(self, expected: np.ndarray, got: np.ndarray) -> float:
        """Add a frame's chunks, (H, D) each, and return their mean absolute error."""
        rows = len(expected)
        if rows > len(self.frames):
            more = ((0, rows - len(self.frames)), (0, 0))
            self.absolute, self.square, self.largest = (
                np.pad(one, more) for one in (self.absolute, self.square, self.largest)
            )
            self.frames = np.pad(self.frames, more[0])
        error = np.abs(got.astype(np.float64) - expected.astype(np.float64))
        self.absolute[:rows] += error
        self.square[:rows] += error**2
        self.largest[:rows] = np.maximum(self.largest[:rows], error)
        self.frames[:rows] += 1
        return float(error.mean())

    def mean(self) -> np.ndarray:
        """Return the mean absolute error, (H, D)."""
        return np.asarray(self.absolute / self.frames[:, np.newaxis])

    def to_json(self, joints: list[str]) -> dict[str, Any]:
        """Return the errors in all, by joint, by step, and by both, in the units of the actions."""
        total = max(1, int(self.frames.sum()))
        mae, rms = self.absolute.sum(0) / total, np.sqrt(self.square.sum(0) / total)
        largest = self.largest.max(0, initial=0)
        by_step = zip(
            self.frames, self.mean().mean(1), np.sqrt((self.square / self.frames[:, None]).mean(1)), strict=True
        )
        return {
            "mae": float(mae.mean()),
            "rmse": float(np.sqrt((rms**2).mean())),
            "max": float(largest.max(initial=0)),
            "by_joint": [
                {"joint": name, "mae": float(mae[i]), "rmse": float(rms[i]), "max": float(largest[i])}
                for i, name in enumerate(joints)
            ],
            "by_step": [
                {"step": step, "frames": int(frames), "mae": float(mean), "rmse": float(root)}
                for step, (frames, mean, root) in enumerate(by_step)
            ],
            "mae_by_step_and_joint": self.mean().tolist(),
        }


@dataclass(frozen=True, slots=True)
class FrameError:
    """The mean absolute error of one frame's chunk."""

    dataset: str
    episode: int
    frame: int
    mae: float


def worst(errors: list[FrameError]) -> list[FrameError]:
    """Return the frames with the largest errors."""
    return sorted(errors, key=lambda one: -one.mae)[:_WORST]
