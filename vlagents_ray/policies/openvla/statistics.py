"""The statistics of a checkpoint's training data: the physical ranges of its normalised numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vlagents_ray.errors import ConfigError, InvalidObservation

Bounds = Literal["q99", "min_max"]  # of each dimension: 1st and 99th percentile, or minimum and maximum
FILE = "dataset_statistics.json"  # written by fine-tuning; it overrides the statistics in config.json
_KEYS = {"q99": ("q01", "q99"), "min_max": ("min", "max")}
_EPSILON = 1e-8  # upstream's value, for dimensions that never moved


@dataclass(frozen=True, slots=True)
class Scale:
    """The conversion between [-1, 1] and physical units, for each dimension."""

    low: np.ndarray  # (D,) float64
    high: np.ndarray  # (D,)
    mask: np.ndarray  # (D,) bool; the other dimensions, such as the gripper, are not normalised

    @property
    def dim(self) -> int:
        """The number of dimensions, D."""
        return len(self.low)

    def restore(self, normalised: np.ndarray) -> np.ndarray:
        """Convert (…, D) in [-1, 1] to physical units, float32."""
        values = 0.5 * (normalised + 1) * (self.high - self.low) + self.low
        return np.where(self.mask, values, normalised).astype(np.float32)

    def restore_spread(self, normalised: np.ndarray) -> np.ndarray:
        """Convert standard deviations (…, D) to physical units, float32."""
        return np.where(self.mask, 0.5 * normalised * (self.high - self.low), normalised).astype(np.float32)

    def normalise(self, values: np.ndarray) -> np.ndarray:
        """Convert (…, D) in physical units to [-1, 1], float32, clipped at the ends of the range."""
        scaled = 2 * (values - self.low) / (self.high - self.low + _EPSILON) - 1
        return np.clip(np.where(self.mask, scaled, values), -1, 1).astype(np.float32)


class Statistics:
    """The statistics of every dataset that a checkpoint was trained on, by its name, the `unnorm_key`."""

    def __init__(self, datasets: Mapping[str, Any], bounds: Bounds = "q99") -> None:
        self._datasets = datasets
        self.bounds = bounds

    @classmethod
    def of(cls, checkpoint: Path, bounds: Bounds = "q99") -> Statistics:
        """Read the statistics in the folder; raises `ConfigError` if there are none."""
        own = (checkpoint / FILE).is_file()
        file = checkpoint / (FILE if own else "config.json")
        try:
            found = json.loads(file.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ConfigError(f"{file}: is no JSON ({error}); copy it again") from error
        if not own:
            found = found.get("norm_stats")
        if not found or not isinstance(found, dict):
            raise ConfigError(
                f"checkpoint {checkpoint}: got no normalisation statistics, want {FILE}, or norm_stats in config.json; "
                f"copy it from where the training run saved it"
            )
        return cls(found, bounds)

    @property
    def names(self) -> list[str]:
        """The names of the datasets."""
        return list(self._datasets)

    def key(self, wanted: str | None) -> str:
        """Return the dataset of that name, with or without `_no_noops`; without a name, the only one.

        Raises `InvalidObservation` with the known names if there is none, or more than one.
        """
        if wanted is None and len(self._datasets) == 1:
            return next(iter(self._datasets))
        for name in (wanted, f"{wanted}_no_noops"):
            if name in self._datasets:
                return str(name)
        raise InvalidObservation(
            f"unnorm_key: got {wanted!r}, want one of the checkpoint's datasets {sorted(self._datasets)}; set it in "
            f"the policy's config, in reset(..., unnorm_key=...) or in an observation's info"
        )

    def scale(self, key: str, part: Literal["action", "proprio"] = "action") -> Scale:
        """Return the ranges of a dataset's actions or proprioception; raises `ConfigError` if it lacks them."""
        found = self._datasets[key].get(part, {})
        low, high = _KEYS[self.bounds]
        if low not in found or high not in found:
            raise ConfigError(
                f"statistics of {key!r}: {part} has {sorted(found)}, want {low!r} and {high!r}; "
                f"were they saved by another version, or with other normalisation bounds?"
            )
        mask = found.get("mask", [True] * len(found[low]))
        return Scale(np.array(found[low], float), np.array(found[high], float), np.array(mask, bool))

    def action_dims(self, wanted: str | None = None) -> set[int]:
        """Return the lengths of the actions of the dataset `wanted`, or of all datasets."""
        return {self.scale(key).dim for key in (self._datasets if wanted is None else [self.key(wanted)])}

    def require(self, wanted: str | None) -> None:
        """Raise `ConfigError` unless the dataset that a deployment names exists."""
        try:
            if wanted is not None:
                self.scale(self.key(wanted))
        except InvalidObservation as error:
            raise ConfigError(str(error)) from error
