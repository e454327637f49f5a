"""What a checkpoint says of its training data: the ranges that its normalised numbers stand for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vlagents_ray.errors import ConfigError, InvalidObservation

Bounds = Literal["q99", "min_max"]  # of each dimension: 1st and 99th percentile, or smallest and largest
FILE = "dataset_statistics.json"  # written by fine-tuning; it goes before the statistics in config.json
_KEYS = {"q99": ("q01", "q99"), "min_max": ("min", "max")}
_EPSILON = 1e-8  # upstream's, for dimensions that never moved


@dataclass(frozen=True, slots=True)
class Scale:
    """Between [-1, 1] and physical units, dimension by dimension."""

    low: np.ndarray  # (D,) float64
    high: np.ndarray  # (D,)
    mask: np.ndarray  # (D,) bool; the others are not normalised, such as the gripper

    @property
    def dim(self) -> int:
        """D."""
        return len(self.low)

    def restore(self, normalised: np.ndarray) -> np.ndarray:
        """(…, D) in [-1, 1] in physical units, float32."""
        values = 0.5 * (normalised + 1) * (self.high - self.low) + self.low
        return np.where(self.mask, values, normalised).astype(np.float32)

    def restore_spread(self, normalised: np.ndarray) -> np.ndarray:
        """Standard deviations (…, D) in physical units, float32."""
        return np.where(self.mask, 0.5 * normalised * (self.high - self.low), normalised).astype(np.float32)

    def normalise(self, values: np.ndarray) -> np.ndarray:
        """(…, D) in physical units as [-1, 1], float32; beyond the range its end."""
        scaled = 2 * (values - self.low) / (self.high - self.low + _EPSILON) - 1
        return np.clip(np.where(self.mask, scaled, values), -1, 1).astype(np.float32)


class Statistics:
    """Of every dataset that a checkpoint was trained on, by its name, the `unnorm_key`."""

    def __init__(self, datasets: Mapping[str, Any], bounds: Bounds = "q99") -> None:
        self._datasets = datasets
        self._bounds = bounds

    @classmethod
    def of(cls, checkpoint: Path, bounds: Bounds = "q99") -> Statistics:
        """Those in the folder. Raises `ConfigError` if there are none."""
        file = checkpoint / FILE
        if file.is_file():
            found = json.loads(file.read_text(encoding="utf-8"))
        else:
            found = json.loads((checkpoint / "config.json").read_text(encoding="utf-8")).get("norm_stats")
        if not found:
            raise ConfigError(
                f"checkpoint {checkpoint}: got no normalisation statistics, want {FILE}, or norm_stats in config.json; "
                f"copy it from where the training run saved it"
            )
        return cls(found, bounds)

    def key(self, wanted: str | None) -> str:
        """The dataset of that name, with or without `_no_noops`; without a name, the only one.

        Raises `InvalidObservation`, listing what there is.
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
        """The ranges of one dataset's actions or proprioception. Raises `ConfigError` if it lacks them."""
        found = self._datasets[key].get(part, {})
        low, high = _KEYS[self._bounds]
        if low not in found or high not in found:
            raise ConfigError(
                f"statistics of {key!r}: {part} has {sorted(found)}, want {low!r} and {high!r}; "
                f"were they saved by another version, or with other normalisation bounds?"
            )
        mask = found.get("mask", [True] * len(found[low]))
        return Scale(np.array(found[low], float), np.array(found[high], float), np.array(mask, bool))

    def action_dims(self, wanted: str | None = None) -> set[int]:
        """The lengths of the actions of the dataset `wanted`, or of all."""
        return {self.scale(key).dim for key in (self._datasets if wanted is None else [self.key(wanted)])}

    def require(self, wanted: str | None) -> None:
        """Raise `ConfigError` unless the dataset that a deployment names is there."""
        try:
            if wanted is not None:
                self.scale(self.key(wanted))
        except InvalidObservation as error:
            raise ConfigError(str(error)) from error
