"""The common parts of OpenVLA and OpenVLA-OFT: settings, the dataset of an answer, the contract."""

from __future__ import annotations

import abc
import copy
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg

from vlagents_ray.contract import ActionSpec
from vlagents_ray.errors import ConfigError, InvalidObservation, NotReset
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row
from vlagents_ray.policies.openvla.prismatic import ActionBins, Prismatic
from vlagents_ray.policies.openvla.statistics import FILE, Scale, Statistics
from vlagents_ray.registry import require

UNNORM_KEY = "unnorm_key"  # key of reset's options and of an observation's info, as sent by OpenVLA's clients
OFFERED = ("logprob", "entropy", "replay")  # of action tokens
_SINGLE_ARM = 7  # six numbers of a motion, and one of the gripper


@dataclass(frozen=True, slots=True)
class PreparedRow:
    """A valid row, ready for the model."""

    row: Row
    scale: Scale  # the scale of its dataset's actions
    model_input: Any


@dataclass(frozen=True, slots=True)
class DecodedChunk:
    """A chunk (H, D) in [-1, 1], and the distribution whose mode it is, where the model states one."""

    values: np.ndarray
    mean: np.ndarray | None = None
    spread: np.ndarray | None = None
    behaviour: dict[str, Any] = field(default_factory=dict)  # what is wanted of the row

    def prediction(self, scale: Scale) -> Prediction:
        """Convert the answer to physical units."""
        return Prediction(
            scale.restore(self.values),
            None if self.mean is None else scale.restore(self.mean),
            None if self.spread is None else scale.restore_spread(self.spread),
            self.behaviour,
        )


class PrismaticPolicy(ModelPolicy):
    """Computes all valid rows of a batch together, each in the units of its own dataset."""

    config: Any
    network = "model.base.network"

    @property
    @abc.abstractmethod
    def _checkpoint(self) -> Prismatic | None:
        """The checkpoint; None before it is loaded."""

    @abc.abstractmethod
    def _model_input(self, row: Row, key: str) -> Any:
        """Return the model's input for a row with that dataset; an error fails that row only."""

    @abc.abstractmethod
    def _compute(self, prepared: Sequence[PreparedRow]) -> list[DecodedChunk]:
        """Compute all rows in one batch."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode; `kwargs` may contain `unnorm_key`, the dataset of its actions."""
        info = super().reset(obs, instruction, **kwargs)
        self._begun().memory[UNNORM_KEY] = self._named(kwargs, self._begun().adapter)
        return info

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """Compute one chunk for each row."""
        results: dict[int, Prediction | Exception] = {}
        prepared: dict[int, PreparedRow] = {}
        for i, row in enumerate(rows):
            try:
                key = self._key(row)
                scale = self._statistics(row.adapter).scale(key)
                prepared[i] = PreparedRow(row, scale, self._model_input(row, key))
            except Exception as error:  # noqa: BLE001 - handed to the session whose request failed
                results[i] = error
        entries = list(prepared.values())
        if entries and self.config.deterministic:  # as many as without errors
            entries += [copy.deepcopy(entries[-1]) for _ in range(len(rows) - len(entries))]
        answers = self._compute(entries)[: len(prepared)] if entries else []
        for (i, entry), answer in zip(prepared.items(), answers, strict=True):
            results[i] = answer.prediction(entry.scale)
        return [results[i] for i in range(len(rows))]

    def _example(self, seed: int, instruction: str = "warm up") -> Row:
        """Return a row of any dataset; sessions may name theirs later."""
        row = super()._example(seed, instruction)
        datasets = self._statistics(row.adapter)
        return replace(row, memory={UNNORM_KEY: self._default(row.adapter) or datasets.names[0]})

    def adapt(self, adapter: str, folder: Path) -> None:
        """Keep the statistics of the adapter's datasets, if they lie beside it."""
        if not (folder / FILE).is_file():
            return
        own, base = Statistics.of(folder, self._statistics().bounds), self._statistics()
        dims = own.action_dims(), base.action_dims(self.config.unnorm_key)
        if not dims[0] <= dims[1]:
            raise ConfigError(
                f"{folder / FILE}: got actions of {sorted(dims[0])} numbers, want {sorted(dims[1])}, as the base's; "
                f"merge the adapter into its base, and serve that as a checkpoint of its own"
            )
        self._checkpoint.own[adapter] = own  # type: ignore[union-attr]

    def _decoded(
        self, bins: ActionBins, prepared: Sequence[PreparedRow], tokens: Any, logits: Any
    ) -> list[DecodedChunk]:
        """Return the chunks of action tokens (B, H, D) that were chosen by logits (B, H, D, V)."""
        parts = bins.values(tokens), *bins.moments(logits)
        chunks = []
        for i, entry in enumerate(prepared):
            values, mean, spread = (part[i, :, : entry.scale.dim] for part in parts)
            chunks.append(DecodedChunk(values, mean, spread, self._stated(bins, entry, tokens[i], logits[i])))
        return chunks

    def _stated(self, bins: ActionBins, entry: PreparedRow, tokens: Any, logits: Any) -> dict[str, Any]:
        """Return what is wanted of a row with tokens (H, D), drawn from the bins by logits (H, D, V)."""
        if not entry.row.want:
            return {}
        tokens = tokens[:, : entry.scale.dim]
        logprob, entropy = map(self._used, bins.stated(tokens, logits[:, : entry.scale.dim]))
        said = {"logprob": logprob, "entropy": float(entropy.sum()), "replay": {"tokens": tokens.cpu().numpy()}}
        return {name: said[name] for name in entry.row.want}

    def _statistics(self, adapter: str = "") -> Statistics:
        checkpoint = self._checkpoint
        if checkpoint is None:
            raise NotReset(f"{type(self).__name__}: not loaded; call initialize() first")
        return checkpoint.own.get(adapter, checkpoint.statistics)

    def _default(self, adapter: str) -> str | None:
        """Return the dataset of the settings; None for an adapter with datasets of its own."""
        return None if self._statistics(adapter) is not self._statistics() else self.config.unnorm_key

    def _named(self, options: Mapping[str, Any], adapter: str) -> str | None:
        """Return the dataset that `options` name, or None."""
        key = options.get(UNNORM_KEY)
        if key is None:
            return None
        if not isinstance(key, str):
            raise InvalidObservation(f"unnorm_key: got {type(key).__name__}, want a dataset's name")
        return self._statistics(adapter).key(key)

    def _key(self, row: Row) -> str:
        """Return the dataset of a row: the observation's, the episode's, the config's, or the only one."""
        named = self._named(row.info, row.adapter) or row.memory.get(UNNORM_KEY) or self._default(row.adapter)
        return self._statistics(row.adapter).key(named)

    def _action(self) -> ActionSpec:
        """Describe an action: its meaning depends on the dataset, except for the gripper of a single arm."""
        dims = set() if self._checkpoint is None else self._statistics().action_dims(self.config.unnorm_key)
        dim = dims.pop() if len(dims) == 1 else None
        single = dim == _SINGLE_ARM
        return ActionSpec(dim=dim, gripper_open=1.0 if single else None, gripper_closed=0.0 if single else None)


SIDE = 224  # px; the size of all images in OpenVLA's training data
CROP_AREA = 0.9  # share of the area that the random crops of training kept
_LOBES = 3  # of the Lanczos kernel


def resized(image: np.ndarray) -> np.ndarray:
    """Resize an (H, W, 3) uint8 image to (224, 224, 3) by JPEG of quality 95 and Lanczos; that size stays unchanged."""
    height, width = image.shape[:2]
    if (height, width) == (SIDE, SIDE):
        return image
    pixels = _apply(_lanczos(height), _lanczos(width), _through_jpeg(image).astype(np.float32))
    return _uint8(np.round(pixels), 255)


def middle(image: np.ndarray) -> np.ndarray:
    """Crop the central nine tenths of the area of an (H, W, 3) uint8 image, and scale them to (224, 224, 3)."""
    height, width = image.shape[:2]
    pixels = _apply(_crop(height), _crop(width), image.astype(np.float32) / 255)
    return _uint8(pixels * 255.5, 255.5)  # TensorFlow's conversion: add a half, then truncate


def _uint8(pixels: np.ndarray, most: float) -> np.ndarray:
    return np.asarray(np.clip(pixels, 0, most), np.uint8)


def _through_jpeg(image: np.ndarray) -> np.ndarray:
    """Compress and decompress the image by the algorithms that TensorFlow chooses.

    Its encoder is Pillow's exact one, its decoder the fast one; simplejpeg's encoder would be off by up to 18.
    """
    file = io.BytesIO()
    require("PIL.Image").fromarray(image).save(file, "JPEG", quality=95, subsampling="4:2:0")
    decoded: np.ndarray = simplejpeg.decode_jpeg(file.getvalue(), "RGB", fastdct=True, fastupsample=False)
    return decoded


def _apply(rows: np.ndarray, columns: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Resample (H, W, 3) by (224, H) and (224, W) weights."""
    turned = np.tensordot(rows, image, (1, 0))  # (224, W, 3)
    return np.asarray(np.tensordot(turned, columns, (1, 1)).transpose(0, 2, 1))


@lru_cache(maxsize=16)
def _lanczos(size: int) -> np.ndarray:
    """Return weights (224, size); kernels are wider where the image shrinks, so that it does not alias."""
    scale = size / SIDE
    centres = (np.arange(SIDE) + 0.5) * scale
    x = ((np.arange(size) + 0.5) - centres[:, None]) / max(scale, 1.0)
    weights = np.where(np.abs(x) < _LOBES, np.sinc(x) * np.sinc(x / _LOBES), 0.0)
    return np.asarray(weights / weights.sum(1, keepdims=True), np.float32)


@lru_cache(maxsize=16)
def _crop(size: int) -> np.ndarray:
    """Return weights (224, size) that scale the centre up, by linear interpolation between the two nearest pixels."""
    side = CROP_AREA**0.5
    at = (1 - side) / 2 * (size - 1) + np.arange(SIDE) * (side * (size - 1) / (SIDE - 1))
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(np.arange(size) - at[:, None])), np.float32)
