"""The common parts of OpenVLA and OpenVLA-OFT: the model, the checkpoint, its statistics, images
and prompts.
"""

from __future__ import annotations

import abc
import contextlib
import hashlib
import importlib
import importlib.util
import io
import json
import os
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import simplejpeg
from pydantic import Field, model_validator
from typing_extensions import Self

from vlagents_ray.contract import ActionSpec
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.accelerator import (
    ensure_torchvision,
    fetch,
    torch_device,
    torch_dtype,
)
from vlagents_ray.policies.base.checkpoint import SavedTensors, find_checkpoint, require_loaded
from vlagents_ray.policies.base.model_inputs import keeping_tokens
from vlagents_ray.policies.base.staging import StagedRow, Staging
from vlagents_ray.policies.outcomes import attempt, compute_valid
from vlagents_ray.registry import require

# Of each dimension: 1st and 99th percentile, or minimum and maximum.
Bounds = Literal["q99", "min_max"]
# Written by fine-tuning; it overrides the statistics in config.json.
FILE = "dataset_statistics.json"
_KEYS = {"q99": ("q01", "q99"), "min_max": ("min", "max")}
_EPSILON = 1e-8  # upstream's value, for dimensions that never moved


@dataclass(frozen=True, slots=True)
class Scale:
    """The conversion between [-1, 1] and physical units, for each dimension."""

    low: np.ndarray  # (D,) float64
    high: np.ndarray  # (D,)
    mask: np.ndarray  # (D,) bool; other dimensions, such as the gripper, are not normalised

    @property
    def dim(self) -> int:
        return len(self.low)

    def restore(self, normalised: np.ndarray) -> np.ndarray:
        """Convert (…, D) in [-1, 1] to physical units, float32."""
        values = 0.5 * (normalised + 1) * (self.high - self.low) + self.low
        return np.where(self.mask, values, normalised).astype(np.float32)

    def restore_spread(self, normalised: np.ndarray) -> np.ndarray:
        """Convert standard deviations (…, D) to physical units, float32."""
        return np.where(self.mask, 0.5 * normalised * (self.high - self.low), normalised).astype(
            np.float32
        )

    def normalise(self, values: np.ndarray) -> np.ndarray:
        """Convert (…, D) in physical units to [-1, 1], float32, clipped at the ends of the
        range.
        """
        scaled = 2 * (values - self.low) / (self.high - self.low + _EPSILON) - 1
        return np.clip(np.where(self.mask, scaled, values), -1, 1).astype(np.float32)


class Statistics:
    """The statistics of all datasets on which a checkpoint was trained, by `unnorm_key`, the
    name of the dataset.
    """

    def __init__(self, datasets: Mapping[str, Any], bounds: Bounds = "q99") -> None:
        self._datasets, self.bounds = datasets, bounds

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
                f"checkpoint {checkpoint}: got no normalisation statistics, want {FILE}, or "
                "norm_stats in config.json; copy it from where the training run saved it"
            )
        return cls(found, bounds)

    @property
    def names(self) -> list[str]:
        return list(self._datasets)

    def key(self, wanted: str | None) -> str:
        """Return the key of the dataset `wanted`, with or without `_no_noops`; None selects the
        only dataset.
        """
        if wanted is None and len(self._datasets) == 1:
            return next(iter(self._datasets))
        for name in (wanted, f"{wanted}_no_noops"):
            if name in self._datasets:
                return str(name)
        raise InvalidObservation(
            f"unnorm_key: got {wanted!r}, want one of the checkpoint's datasets "
            f"{sorted(self._datasets)}; set it in the policy's config, in reset(..., "
            "unnorm_key=...) or in an observation's info"
        )

    def scale(self, key: str, part: Literal["action", "proprio"] = "action") -> Scale:
        """Return the ranges of a dataset's actions or proprioception; raises `ConfigError` if it
        lacks them.
        """
        found = self._datasets[key].get(part, {})
        low, high = _KEYS[self.bounds]
        if low not in found or high not in found:
            raise ConfigError(
                f"statistics of {key!r}: {part} has {sorted(found)}, want {low!r} and {high!r}; "
                f"were they saved by another version, or with other normalisation bounds?"
            )
        mask = found.get("mask", [True] * len(found[low]))
        return Scale(
            np.array(found[low], float), np.array(found[high], float), np.array(mask, bool)
        )

    def action_dims(self, wanted: str | None = None) -> set[int]:
        """Return the lengths of the actions of the dataset `wanted`, or of all datasets."""
        return {
            self.scale(key).dim
            for key in (self._datasets if wanted is None else [self.key(wanted)])
        }

    def require(self, wanted: str | None) -> None:
        """Raise `ConfigError` unless the dataset `wanted` by a deployment exists."""
        try:
            if wanted is not None:
                self.scale(self.key(wanted))
        except InvalidObservation as error:
            raise ConfigError(str(error)) from error


_NEEDS = ("config.json", "preprocessor_config.json", "tokenizer_config.json", "*.safetensors")
_SPACE = 29871  # Llama's token of an empty word, between "Out:" and the action in training
_PIXELS = "pixels"
_PROMPT = "In: What action should the robot take to {}?\nOut:"
# OpenVLA v0.1 was fine-tuned from Vicuna; upstream also detects it by the checkpoint's name.
_PROMPT_V01 = (
    "A chat between a curious user and an artificial intelligence assistant. The assistant gives "
    "helpful, detailed, and polite answers to the user's questions. USER: What action should the "
    "robot take to {}? ASSISTANT:"
)


@dataclass(frozen=True)
class Prismatic:
    """A loaded checkpoint."""

    path: Path
    # OpenVLAForActionPrediction; uses its vision_backbone, projector and language_model.
    network: Any
    tokenizer: Any
    processor: Any  # PrismaticImageProcessor
    bins: ActionBins
    statistics: Statistics
    prompt: str
    device: Any
    dtype: Any
    staging: Staging
    # The length to which shorter prompts are padded; 0: that of the longest prompt.
    padded_tokens: int
    # Of adapters that were trained on other datasets.
    own: dict[str, Statistics] = field(default_factory=dict)

    def stage(self, images: Sequence[np.ndarray]) -> StagedRow:
        """Begin to copy V images, (H, W, 3) uint8, as inputs of the checkpoint's backbones, to
        the model's device.
        """
        convert = require("PIL.Image").fromarray
        pixels = [self.processor.apply_transform(convert(image)).numpy() for image in images]
        return self.staging.stage({_PIXELS: np.stack(pixels)})

    def pixels(self, rows: Sequence[StagedRow]) -> Any:
        """Return the images (B, V, C, S, S) of rows of `stage`, on the device and in the model's
        dtype.
        """
        return self.staging.stack(rows)[_PIXELS].to(self.dtype)

    def tokens(self, instruction: str) -> list[int]:
        """Return the prompt's tokens, read-only; raises `InvalidObservation` if the instruction
        is too long.
        """
        ids = self._tokenized(instruction)
        most = self.network.config.llm_max_length
        if len(ids) > most:
            raise InvalidObservation(
                f"instruction: got {len(ids)} tokens with the prompt, want {most} at most"
            )
        return ids

    @cached_property
    def _tokenized(self) -> Callable[[str], list[int]]:
        """Tokenizes an instruction, with a cache, since it is the same in each act of a session."""

        @keeping_tokens
        def tokenized(instruction: str) -> list[int]:
            ids: list[int] = self.tokenizer(self.prompt.format(instruction.lower())).input_ids
            return ids if ids[-1] == _SPACE else [*ids, _SPACE]

        return tokenized

    def moved(self, numbers: Any) -> Any:
        """Copy numbers to the model's device, without waiting for what a GPU computes."""
        return self.staging.upload(np.asarray(numbers))

    def padded(self, rows: Sequence[Sequence[int]], length: int = 0, *, left: bool = False) -> Any:
        """Return rows of int64 on the device with zeros after them, or before them, up to the
        longest or `length`.
        """
        found = np.zeros((len(rows), max(length, *map(len, rows))), np.int64)
        for row, numbers in zip(found, rows, strict=True):
            row[slice(-len(numbers), None) if left else slice(len(numbers))] = numbers
        return self.moved(found)

    def embed(self, tokens: Any) -> Any:
        """Return the embeddings (…, D) of tokens (…)."""
        return self.network.get_input_embeddings()(tokens)

    @staticmethod
    def assembled(parts: Sequence[Any], places: Any) -> Any:
        """Return sequences (B, L, D) of the parts (B, N, D) at places (B, L), which count from
        1; at 0 are zeros.
        """
        zeros = parts[0].new_zeros(len(places), 1, parts[0].shape[-1])
        return require("torch").cat([zeros, *parts], 1).take_along_dim(places[..., None], 1)


def load_prismatic(config: PrismaticConfig, bounds: Bounds = "q99") -> Prismatic:
    path = find_checkpoint(config.checkpoint, config.checkpoint_step, _NEEDS)
    statistics = Statistics.of(path, bounds)
    statistics.require(config.unnorm_key)
    device = torch_device(config.device)
    dtype = torch_dtype(config.dtype, device)
    ensure_torchvision()
    transformers = require("transformers")
    model_class, processor_class = model_classes(path, config.source_dir, config.trust_remote_code)
    network = model_class.from_pretrained(
        path, torch_dtype=dtype, attn_implementation=config.attention, low_cpu_mem_usage=True
    )
    require_loaded(network, SavedTensors.open(path))
    return Prismatic(
        path=path,
        network=network.to(device).eval().requires_grad_(False),
        tokenizer=transformers.AutoTokenizer.from_pretrained(path),
        processor=processor_class.from_pretrained(path),
        bins=ActionBins(network.config, device),
        statistics=statistics,
        prompt=_PROMPT_V01 if "openvla-v01" in config.checkpoint else _PROMPT,
        device=device,
        staging=Staging(device),
        dtype=dtype,
        padded_tokens=config.compiled_tokens if config.compile_on(device.type) else 0,
    )


class PrismaticConfig(ModelConfig):
    """Settings of OpenVLA and OpenVLA-OFT."""

    compiled_tokens: int = Field(
        default=64,
        ge=1,
        description="compiled: tokens to which prompts are padded; longer ones run without "
        "compilation",
    )
    unnorm_key: str | None = Field(
        default=None,
        description="dataset whose statistics turn answers into physical units, with or without "
        "`_no_noops`; unset: "
        "the checkpoint's only one, or the one that `reset` or an observation names",
    )
    source_dir: str | None = Field(
        default=None,
        description="a clone of openvla or openvla-oft, for the model's classes; unset: "
        "$OPENVLA_SRC, "
        "$OPENVLA_OFT_SRC, or an installed `prismatic`",
    )
    trust_remote_code: bool = Field(
        default=False,
        description="run the Python code in the checkpoint's folder instead: write access to it, "
        "or to the hub's "
        "repository, then gives all rights of this process",
    )
    attention: Literal["sdpa", "eager", "flash_attention_2"] = Field(
        default="sdpa",
        description="of the language model; flash_attention_2 needs the package flash-attn and a "
        "GPU",
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.trust_remote_code and self.source_dir:
            raise ValueError(
                "source_dir and trust_remote_code: got both, want the model's classes from one of "
                "them"
            )
        return self


class ActionBins:
    """The bins of [-1, 1], which are the last tokens of the vocabulary; the very last token is
    the lowest bin.
    """

    def __init__(self, config: Any, device: Any) -> None:
        torch = require("torch")
        edges = np.linspace(-1, 1, config.n_action_bins)
        middles = (edges[:-1] + edges[1:]) / 2
        self._first = config.text_config.vocab_size - config.pad_to_multiple_of - 1
        # there is one token more than there are bins
        self._middles = torch.tensor(np.append(middles, middles[-1]), device=device)
        self._tokens = self._first - torch.arange(config.n_action_bins, device=device)

    def read(self, logits: Any) -> tuple[Any, Any]:
        """Return the likeliest of all tokens (…), and the logits of bins (…, bins), float64, of
        logits (…, V).
        """
        return logits.argmax(-1), logits[..., self._tokens].double()

    def choose(self, likeliest: Any, over: Any, draws: Any) -> Any:
        """Choose tokens (…) from the results of `read`: bins at given quantiles, or the likeliest
        tokens.

        An element of `draws` (…), in [0, 1), is a quantile of the distribution over bins; NaN
        selects the likeliest of all tokens, as upstream does.
        """
        torch = require("torch")
        upto = over.softmax(-1).cumsum(-1)
        drawn = (upto > (draws * upto[..., -1])[..., None]).int().argmax(-1)
        return torch.where(draws.isnan(), likeliest, self._tokens[drawn])

    def logprob(self, tokens: Any, logits: Any) -> Any:
        """Return the log-probabilities (…) of tokens (…) among the bins, nats, differentiable in
        logits (…, V).
        """
        over = logits[..., self._tokens].double().log_softmax(-1)
        return over.gather(-1, (self._first - tokens)[..., None])[..., 0]

    def stated(self, tokens: Any, over: Any) -> np.ndarray:
        """Return what is known of tokens (…) by the logits of bins, (…, bins) float64, with one
        copy from the device.

        Returns:
            (6, …) float64: values in [-1, 1], of the nearest bin for other tokens, as upstream;
            mean and standard deviation over the bins; log-probability and entropy, nats; and the
            tokens.
        """
        torch = require("torch")
        share, bins = over.softmax(-1), (self._first - tokens).clamp(0, len(self._middles) - 1)
        mean = share @ self._middles
        spread = (share * (self._middles - mean[..., None]) ** 2).sum(-1).sqrt()
        logprob = over.log_softmax(-1).gather(-1, bins[..., None])[..., 0]
        entropy = torch.special.entr(share).sum(-1)
        return fetch(
            torch.stack([self._middles[bins], mean, spread, logprob, entropy, tokens.double()])
        )


MODEL, PROCESSOR = "OpenVLAForActionPrediction", "PrismaticImageProcessor"
# Either serves both policies, which use code common to both.
VARIABLES = ("OPENVLA_SRC", "OPENVLA_OFT_SRC")
_PACKAGES = (
    "prismatic",
    "prismatic.extern",
    "prismatic.extern.hf",
    "prismatic.training",
    "prismatic.vla",
)


def model_classes(
    checkpoint: Path, source_dir: str | None, trust_remote_code: bool
) -> tuple[Any, Any]:
    """Return the classes of the model and of its image processor.

    With `trust_remote_code`, they are the classes that the checkpoint's files name: Python code
    that runs with all rights of this process. Otherwise they come from the source tree:
    `source_dir`, $OPENVLA_SRC, $OPENVLA_OFT_SRC, or an installed `prismatic`.

    Raises:
        ConfigError: The classes are not found.
    """
    if trust_remote_code:
        return (
            _remote(checkpoint, "config.json", "AutoModelForVision2Seq"),
            _remote(checkpoint, "preprocessor_config.json", "AutoImageProcessor"),
        )
    return _from_source(find_source(source_dir))


def _remote(checkpoint: Path, file: str, auto: str) -> Any:
    named = (
        json.loads((checkpoint / file).read_text(encoding="utf-8")).get("auto_map", {}).get(auto)
    )
    if named is None:
        raise ConfigError(
            f"trust_remote_code: {checkpoint / file} names no code (auto_map has no {auto!r}); "
            f"take the classes from a source tree instead: set source_dir"
        )
    return require("transformers.dynamic_module_utils").get_class_from_dynamic_module(
        named, str(checkpoint)
    )


def find_source(source_dir: str | None) -> Path:
    """Return the folder that holds the package `prismatic`."""
    asked = (
        [source_dir]
        if source_dir
        else [os.environ[name] for name in VARIABLES if os.environ.get(name)]
    )
    if not asked:
        spec = importlib.util.find_spec("prismatic")  # finds without importing
        asked = (
            [str(Path(found).parent) for found in (spec.submodule_search_locations or ())]
            if spec
            else []
        )
    for folder in asked:
        root = Path(folder).expanduser().resolve()
        if (root / "prismatic/extern/hf/modeling_prismatic.py").is_file():
            return root
    raise ConfigError(
        f"OpenVLA's model classes: got {asked or 'no source tree'}, want a folder with "
        f"prismatic/extern/hf in it; set source_dir or ${VARIABLES[0]} to a clone of openvla or "
        "openvla-oft, or, if you trust the Python code that lies beside the weights, "
        "trust_remote_code: true"
    )


@lru_cache(maxsize=4)
def _from_source(root: Path) -> tuple[Any, Any]:
    # OFT's code prints settings that do not apply here
    with _bare_packages(root), contextlib.redirect_stdout(io.StringIO()):
        modeling = importlib.import_module("prismatic.extern.hf.modeling_prismatic")
        processing = importlib.import_module("prismatic.extern.hf.processing_prismatic")
    return getattr(modeling, MODEL), getattr(processing, PROCESSOR)


@contextlib.contextmanager
def _bare_packages(root: Path) -> Iterator[None]:
    """Import from `root` without the packages' own `__init__`, which would import TensorFlow and
    more.
    """
    before = _take_out()
    for name in _PACKAGES:
        package = types.ModuleType(name)
        package.__path__ = [str(root.joinpath(*name.split(".")))]
        sys.modules[name] = package
    try:
        yield
    finally:
        # torch.compile imports the module of a function that it compiles, by the module's name
        alias = f"prismatic_{hashlib.sha256(str(root).encode()).hexdigest()[:16]}"
        for name, module in _take_out().items():
            module.__name__ = name.replace("prismatic", alias, 1)
            sys.modules[module.__name__] = module
        sys.modules.update(before)


def _take_out() -> dict[str, types.ModuleType]:
    names = [name for name in sys.modules if name.partition(".")[0] == "prismatic"]
    return {name: sys.modules.pop(name) for name in names}


# Key of reset's options and of an observation's info, as sent by OpenVLA's clients.
UNNORM_KEY = "unnorm_key"
OFFERED = ("logprob", "entropy", "replay")  # of action tokens
_SINGLE_ARM = 7  # six numbers for motion, one for the gripper


@dataclass(frozen=True, slots=True)
class PreparedRow:
    """A valid row, ready for the model."""

    row: Row
    scale: Scale  # of the actions of its dataset
    model_input: Any


class PrismaticPolicy(ModelPolicy):
    """Computes all valid rows of a batch together, each in the units of its own dataset."""

    config: Any
    network = "model.base.network"

    @abc.abstractmethod
    def _model_input(self, row: Row, key: str) -> Any:
        """Return the model's input for a row of the dataset `key`; an error fails only that row."""

    @abc.abstractmethod
    def _compute(self, prepared: Sequence[PreparedRow]) -> list[Prediction]:
        """Compute all rows in one batch."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode; `kwargs` may contain `unnorm_key`, the dataset of its actions."""
        info = super().reset(obs, instruction, **kwargs)
        self._begun().memory[UNNORM_KEY] = self._named(kwargs, self._begun().adapter)
        return info

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        def prepare(row: Row) -> PreparedRow:
            key = self._key(row)
            return PreparedRow(
                row, self._statistics(row.adapter).scale(key), self._model_input(row, key)
            )

        return compute_valid([attempt(prepare, row) for row in rows], self._compute)

    def _example(self, seed: int, instruction: str = "warm up") -> Row:
        """Return a row of any dataset; sessions may select theirs later."""
        row = super()._example(seed, instruction)
        datasets = self._statistics(row.adapter)
        return replace(row, memory={UNNORM_KEY: self._default(row.adapter) or datasets.names[0]})

    def adapt(self, adapter: str, folder: Path) -> None:
        """Keep the statistics of the adapter's datasets, if its folder has them."""
        if not (folder / FILE).is_file():
            return
        own, base = Statistics.of(folder, self._statistics().bounds), self._statistics()
        dims = own.action_dims(), base.action_dims(self.config.unnorm_key)
        if not dims[0] <= dims[1]:
            raise ConfigError(
                f"{folder / FILE}: got actions of {sorted(dims[0])} numbers, want "
                f"{sorted(dims[1])}, as the base's; merge the adapter into its base, and serve "
                "that as a checkpoint of its own"
            )
        self.model.base.own[adapter] = own

    def _decoded(
        self, bins: ActionBins, prepared: Sequence[PreparedRow], tokens: Any, over: Any
    ) -> list[Prediction]:
        """Return the chunks of action tokens (B, H, D) that were chosen by the logits of bins
        (B, H, D, bins).
        """
        chunks, parts = [], bins.stated(tokens, over)
        for i, entry in enumerate(prepared):
            scale = entry.scale
            values, mean, spread, logprob, entropy, chosen = parts[:, i, :, : scale.dim]
            said = {
                "logprob": self._used(logprob),
                "entropy": float(self._used(entropy).sum()),
                "replay": {"tokens": chosen.astype(np.int64)},
            }
            found = scale.restore(values), scale.restore(mean), scale.restore_spread(spread)
            chunks.append(Prediction(*found, {name: said[name] for name in entry.row.want}))
        return chunks

    def _statistics(self, adapter: str = "") -> Statistics:
        base: Prismatic = self.loaded().base
        return base.own.get(adapter, base.statistics)

    def _default(self, adapter: str) -> str | None:
        """Return the dataset of the settings; None for an adapter with its own datasets."""
        return (
            None if self._statistics(adapter) is not self._statistics() else self.config.unnorm_key
        )

    def _named(self, options: Mapping[str, Any], adapter: str) -> str | None:
        if (key := options.get(UNNORM_KEY)) is None:
            return None
        if not isinstance(key, str):
            raise InvalidObservation(f"unnorm_key: got {type(key).__name__}, want a dataset's name")
        return self._statistics(adapter).key(key)

    def _key(self, row: Row) -> str:
        """Return the dataset of a row: that of the observation, the episode or the settings, or
        the only one.
        """
        named = (
            self._named(row.info, row.adapter)
            or row.memory.get(UNNORM_KEY)
            or self._default(row.adapter)
        )
        return self._statistics(row.adapter).key(named)

    def _action(self) -> ActionSpec:
        """Describe an action: its meaning depends on the dataset, except for the gripper of a
        single arm.
        """
        dims = (
            set() if self.model is None else self._statistics().action_dims(self.config.unnorm_key)
        )
        dim = dims.pop() if len(dims) == 1 else None
        single = dim == _SINGLE_ARM
        return ActionSpec(
            dim=dim, gripper_open=1.0 if single else None, gripper_closed=0.0 if single else None
        )


SIDE = 224  # px; the size of all images in OpenVLA's training data
CROP_AREA = 0.9  # share of the area that training's random crops kept
_LOBES = 3  # of the Lanczos kernel


def resized(image: np.ndarray) -> np.ndarray:
    """Resize an (H, W, 3) uint8 image to (224, 224, 3) by JPEG of quality 95 and Lanczos, unless
    it has that size.
    """
    height, width = image.shape[:2]
    if (height, width) == (SIDE, SIDE):
        return image
    pixels = _apply(_lanczos(height), _lanczos(width), _through_jpeg(image).astype(np.float32))
    return _uint8(np.round(pixels), 255)


def middle(image: np.ndarray) -> np.ndarray:
    """Crop the central nine tenths of the area of an (H, W, 3) uint8 image, and scale them to
    (224, 224, 3).
    """
    height, width = image.shape[:2]
    pixels = _apply(_crop(height), _crop(width), image.astype(np.float32) / 255)
    return _uint8(pixels * 255.5, 255.5)  # as TensorFlow converts: add a half, then truncate


def _uint8(pixels: np.ndarray, most: float) -> np.ndarray:
    return np.asarray(np.clip(pixels, 0, most), np.uint8)


def _through_jpeg(image: np.ndarray) -> np.ndarray:
    """Compress and decompress the image with the algorithms that TensorFlow uses.

    Its encoder is Pillow's exact one, its decoder the fast one; simplejpeg's encoder differs by up
    to 18.
    """
    file = io.BytesIO()
    require("PIL.Image").fromarray(image).save(file, "JPEG", quality=95, subsampling="4:2:0")
    decoded: np.ndarray = simplejpeg.decode_jpeg(
        file.getvalue(), "RGB", fastdct=True, fastupsample=False
    )
    return decoded


def _apply(rows: np.ndarray, columns: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Resample (H, W, 3) by (224, H) and (224, W) weights."""
    turned = np.tensordot(rows, image, (1, 0))  # (224, W, 3)
    return np.asarray(np.tensordot(turned, columns, (1, 1)).transpose(0, 2, 1))


@lru_cache(maxsize=16)
def _lanczos(size: int) -> np.ndarray:
    """Return weights (224, size); kernels are wider where the image shrinks, so that it does not
    alias.
    """
    scale = size / SIDE
    centres = (np.arange(SIDE) + 0.5) * scale
    x = ((np.arange(size) + 0.5) - centres[:, None]) / max(scale, 1.0)
    weights = np.where(np.abs(x) < _LOBES, np.sinc(x) * np.sinc(x / _LOBES), 0.0)
    return np.asarray(weights / weights.sum(1, keepdims=True), np.float32)


@lru_cache(maxsize=16)
def _crop(size: int) -> np.ndarray:
    """Return weights (224, size) that scale the centre up, by linear interpolation between the
    two nearest pixels.
    """
    side = CROP_AREA**0.5
    at = (1 - side) / 2 * (size - 1) + np.arange(SIDE) * (side * (size - 1) / (SIDE - 1))
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(np.arange(size) - at[:, None])), np.float32)
