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
from dataclasses import dataclass, replace
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
from vlagents_ray.policies.base.adapter import LoraAdapter
from vlagents_ray.policies.base.checkpoint import SavedTensors, find_checkpoint, require_loaded
from vlagents_ray.policies.base.model_inputs import keeping_tokens
from vlagents_ray.policies.base.staging import StagedRow, Staging
from vlagents_ray.policies.outcomes import attempt, compute_valid
from vlagents_ray.registry import require

# The bounds of each dimension's range: 1st and 99th percentile, or minimum and maximum.
Bounds = Literal["q99", "min_max"]
_STATISTICS = {"q99": ("q01", "q99"), "min_max": ("min", "max")}

# This file is written by fine-tuning. It has priority over the statistics in config.json.
STATISTICS_FILE = "dataset_statistics.json"
_EPSILON = 1e-8  # upstream's value, for dimensions that never changed


@dataclass(frozen=True, slots=True)
class Scale:
    """The conversion between [-1, 1] and physical units, for each dimension."""

    low: np.ndarray  # (D,) float64
    high: np.ndarray  # (D,)
    # Dimensions that are normalised, (D,) bool; others, such as the gripper, are unchanged.
    mask: np.ndarray

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
        values = 0.5 * normalised * (self.high - self.low)
        return np.where(self.mask, values, normalised).astype(np.float32)

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
    def from_folder(cls, checkpoint: Path, bounds: Bounds = "q99") -> Statistics:
        """Read the statistics in a checkpoint's folder.

        Args:
            checkpoint: The folder.
            bounds: The statistics with which values were normalised in training.

        Raises:
            ConfigError: The folder has no statistics.
        """
        has_own_file = (checkpoint / STATISTICS_FILE).is_file()
        file = checkpoint / (STATISTICS_FILE if has_own_file else "config.json")
        try:
            datasets = json.loads(file.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ConfigError(f"{file}: is no JSON ({error}); copy it again") from error

        if not has_own_file:
            datasets = datasets.get("norm_stats")
        if not datasets or not isinstance(datasets, dict):
            raise ConfigError(
                f"checkpoint {checkpoint}: expected {STATISTICS_FILE}, or norm_stats in "
                "config.json, got no normalisation statistics; copy the file from where the "
                "training run saved it"
            )
        return cls(datasets, bounds)

    @property
    def names(self) -> list[str]:
        """The names of all datasets."""
        return list(self._datasets)

    def key(self, name: str | None) -> str:
        """Return the key of a dataset in these statistics.

        Args:
            name: The name of the dataset, with or without `_no_noops`; None selects the only
                dataset.

        Raises:
            InvalidObservation: The dataset does not exist, or `name` is None and there are several
                datasets.
        """
        if name is None and len(self._datasets) == 1:
            return next(iter(self._datasets))
        for key in (name, f"{name}_no_noops"):
            if key in self._datasets:
                return str(key)
        raise InvalidObservation(
            f"unnorm_key: expected one of the checkpoint's datasets {sorted(self._datasets)}, got "
            f"{name!r}; set it in the policy's config, in reset(..., unnorm_key=...) or in an "
            "observation's info"
        )

    def scale(self, key: str, feature: Literal["action", "proprio"] = "action") -> Scale:
        """Return the ranges of a dataset's actions or proprioception.

        Raises:
            ConfigError: The statistics contain no such ranges.
        """
        statistics = self._datasets[key].get(feature, {})
        low, high = _STATISTICS[self.bounds]
        if low not in statistics or high not in statistics:
            raise ConfigError(
                f"statistics of {key!r}: {feature}: expected {low!r} and {high!r}, got "
                f"{sorted(statistics)}; check whether they were saved by another version, or with "
                "other normalisation bounds"
            )

        mask = statistics.get("mask", [True] * len(statistics[low]))
        return Scale(
            np.array(statistics[low], float),
            np.array(statistics[high], float),
            np.array(mask, bool),
        )

    def action_dims(self, name: str | None = None) -> set[int]:
        """Return the lengths of the actions of a dataset, or of all datasets for None."""
        keys = self._datasets if name is None else [self.key(name)]
        return {self.scale(key).dim for key in keys}

    def require(self, name: str | None) -> None:
        """Check the dataset that a deployment selects, or None if it selects none.

        Raises:
            ConfigError: The dataset does not exist, or has no ranges of actions.
        """
        if name is None:
            return
        try:
            key = self.key(name)
        except InvalidObservation as error:
            raise ConfigError(str(error)) from error
        self.scale(key)


_NEEDS = ("config.json", "preprocessor_config.json", "tokenizer_config.json", "*.safetensors")
# Llama's token for an empty word, which was between "Out:" and the action in training.
_SPACE = 29871
_PIXELS = "pixels"
_PROMPT = "In: What action should the robot take to {}?\nOut:"
# OpenVLA v0.1 was fine-tuned from Vicuna. Upstream also detects this version by the name of the
# checkpoint.
_PROMPT_V01 = (
    "A chat between a curious user and an artificial intelligence assistant. The assistant gives "
    "helpful, detailed, and polite answers to the user's questions. USER: What action should the "
    "robot take to {}? ASSISTANT:"
)


@dataclass(frozen=True)
class Prismatic:
    """A loaded checkpoint."""

    path: Path
    # An OpenVLAForActionPrediction, of which vision_backbone, projector and language_model are
    # used.
    network: Any
    tokenizer: Any
    processor: Any  # a PrismaticImageProcessor
    bins: ActionBins
    statistics: Statistics
    prompt: str
    device: Any
    dtype: Any
    staging: Staging
    # The length to which shorter prompts are padded; 0 means the length of the longest prompt.
    padded_tokens: int

    def stage(self, images: Sequence[np.ndarray]) -> StagedRow:
        """Convert V images, (H, W, 3) uint8, to the format of the checkpoint's backbones, and begin
        to copy them to the model's device.
        """
        convert = require("PIL.Image").fromarray
        pixels = [self.processor.apply_transform(convert(image)).numpy() for image in images]
        return self.staging.stage({_PIXELS: np.stack(pixels)})

    def pixels(self, rows: Sequence[StagedRow]) -> Any:
        """Return the images of staged rows, (B, V, C, S, S), on the device and in the model's
        dtype.
        """
        return self.staging.stack(rows)[_PIXELS].to(self.dtype)

    def tokens(self, instruction: str) -> list[int]:
        """Return the tokens of the prompt for an instruction, which callers must not change.

        Raises:
            InvalidObservation: The instruction is too long.
        """
        tokens = self._tokenize(instruction)
        max_tokens = self.network.config.llm_max_length
        if len(tokens) > max_tokens:
            raise InvalidObservation(
                f"instruction: expected at most {max_tokens} tokens with the prompt, got "
                f"{len(tokens)}; shorten it"
            )
        return tokens

    @cached_property
    def _tokenize(self) -> Callable[[str], list[int]]:
        """A cached function that tokenizes the prompt for an instruction.

        A session uses the same instruction in each call.
        """

        @keeping_tokens
        def tokenize(instruction: str) -> list[int]:
            prompt = self.prompt.format(instruction.lower())
            tokens: list[int] = self.tokenizer(prompt).input_ids
            return tokens if tokens[-1] == _SPACE else [*tokens, _SPACE]

        return tokenize

    def upload(self, numbers: Any) -> Any:
        """Copy numbers to the model's device, without waiting for computations of the GPU."""
        return self.staging.upload(np.asarray(numbers))

    def pad(self, rows: Sequence[Sequence[int]], length: int = 0, *, left: bool = False) -> Any:
        """Pad rows of integers with zeros, and copy them to the device.

        Args:
            rows: B rows.
            length: The smallest length of the result.
            left: Whether the zeros are before the rows instead of after them.

        Returns:
            (B, L) int64, where L is `length`, or the length of the longest row if that is larger.
        """
        padded = np.zeros((len(rows), max(length, *map(len, rows))), np.int64)
        for target, numbers in zip(padded, rows, strict=True):
            if left:
                target[-len(numbers) :] = numbers
            else:
                target[: len(numbers)] = numbers
        return self.upload(padded)

    def embed(self, tokens: Any) -> Any:
        """Return the embeddings, (…, D), of tokens, (…)."""
        return self.network.get_input_embeddings()(tokens)

    @staticmethod
    def assemble(segments: Sequence[Any], indices: Any) -> Any:
        """Assemble sequences from the embeddings of concatenated segments.

        Args:
            segments: The embeddings of each segment, (B, N, D), where N may differ between
                segments.
            indices: For each position of a sequence, an index into the concatenation of the row's
                segments, counted from 1, (B, L). 0 selects a vector of zeros.

        Returns:
            The sequences, (B, L, D).
        """
        zeros = segments[0].new_zeros(len(indices), 1, segments[0].shape[-1])
        return require("torch").cat([zeros, *segments], 1).take_along_dim(indices[..., None], 1)


def load_prismatic(
    config: PrismaticConfig, bounds: Bounds = "q99", adapter: LoraAdapter | None = None
) -> Prismatic:
    """Load a checkpoint of OpenVLA, or the base of an OpenVLA-OFT checkpoint.

    Args:
        config: The settings of the policy.
        bounds: The statistics with which values were normalised in training.
        adapter: The adapter of the checkpoint, whose folder may contain other statistics.

    Returns:
        The checkpoint, on its device and in evaluation mode.

    Raises:
        ConfigError: The checkpoint is incomplete, or the settings do not fit it.
    """
    path = find_checkpoint(config.checkpoint, config.checkpoint_step, _NEEDS)
    statistics_folder = path
    if adapter is not None and (adapter.folder / STATISTICS_FILE).is_file():
        statistics_folder = adapter.folder
    statistics = Statistics.from_folder(statistics_folder, bounds)
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
        "`_no_noops`; unset: the checkpoint's only one, or the one that `reset` or an observation "
        "names",
    )
    source_dir: str | None = Field(
        default=None,
        description="a clone of openvla or openvla-oft, for the model's classes; unset: "
        "$OPENVLA_SRC, $OPENVLA_OFT_SRC, or an installed `prismatic`",
    )
    trust_remote_code: bool = Field(
        default=False,
        description="run the Python code in the checkpoint's folder instead: write access to it, "
        "or to the hub's repository, then gives all rights of this process",
    )
    attention: Literal["sdpa", "eager", "flash_attention_2"] = Field(
        default="sdpa",
        description="attention of the language model; flash_attention_2 needs the package "
        "flash-attn and a GPU",
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.trust_remote_code and self.source_dir:
            raise ValueError(
                "source_dir and trust_remote_code: expected one of them as the source of the "
                "model's classes, got both; leave one out"
            )
        return self


class ActionBins:
    """The bins of [-1, 1], which are the last tokens of the vocabulary.

    The very last token is the lowest bin.
    """

    def __init__(self, config: Any, device: Any) -> None:
        torch = require("torch")
        edges = np.linspace(-1, 1, config.n_action_bins)
        middles = (edges[:-1] + edges[1:]) / 2
        self._first = config.text_config.vocab_size - config.pad_to_multiple_of - 1
        # There is one more token than bins.
        self._middles = torch.tensor(np.append(middles, middles[-1]), device=device)
        self._tokens = self._first - torch.arange(config.n_action_bins, device=device)

    def read(self, logits: Any) -> tuple[Any, Any]:
        """Read the logits of a language model.

        Args:
            logits: The logits of all tokens of the vocabulary, (…, V).

        Returns:
            The most likely of all tokens, (…), and the logits of the bins, (…, bins) float64.
        """
        return logits.argmax(-1), logits[..., self._tokens].double()

    def choose(self, likeliest: Any, bin_logits: Any, draws: Any) -> Any:
        """Choose tokens: bins at the given quantiles, or the most likely tokens.

        Args:
            likeliest: The most likely of all tokens, (…), from `read`.
            bin_logits: The logits of the bins (…, bins), from `read`.
            draws: Quantiles of the distributions over bins, (…) in [0, 1). NaN selects the most
                likely of all tokens, as upstream does.

        Returns:
            The tokens (…).
        """
        torch = require("torch")
        cumulative = bin_logits.softmax(-1).cumsum(-1)
        exceeds = cumulative > (draws * cumulative[..., -1])[..., None]
        drawn = exceeds.int().argmax(-1)
        return torch.where(draws.isnan(), likeliest, self._tokens[drawn])

    def logprob(self, tokens: Any, logits: Any) -> Any:
        """Return the log-probabilities of tokens among the bins, (…) nats.

        The result is differentiable with respect to the logits, (…, V).
        """
        log_shares = logits[..., self._tokens].double().log_softmax(-1)
        return log_shares.gather(-1, (self._first - tokens)[..., None])[..., 0]

    def describe(self, tokens: Any, bin_logits: Any) -> np.ndarray:
        """Compute the values and the distributions of tokens, with a single copy from the device.

        Args:
            tokens: The chosen tokens (…).
            bin_logits: The logits of the bins (…, bins), float64.

        Returns:
            (6, …) float64: values in [-1, 1], where other tokens have the value of the nearest bin,
            as upstream; mean and standard deviation over the bins; log-probability and entropy,
            nats; and the tokens.
        """
        torch = require("torch")
        shares = bin_logits.softmax(-1)
        bins = (self._first - tokens).clamp(0, len(self._middles) - 1)
        mean = shares @ self._middles
        spread = (shares * (self._middles - mean[..., None]) ** 2).sum(-1).sqrt()
        logprob = bin_logits.log_softmax(-1).gather(-1, bins[..., None])[..., 0]
        entropy = torch.special.entr(shares).sum(-1)
        return fetch(
            torch.stack([self._middles[bins], mean, spread, logprob, entropy, tokens.double()])
        )


MODEL, PROCESSOR = "OpenVLAForActionPrediction", "PrismaticImageProcessor"
# Either variable is sufficient for both policies, which use the code that both repositories share.
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


def _remote(checkpoint: Path, file: str, auto_class: str) -> Any:
    """Return the class that a JSON file of the checkpoint assigns to a class of transformers."""
    content = json.loads((checkpoint / file).read_text(encoding="utf-8"))
    class_reference = content.get("auto_map", {}).get(auto_class)
    if class_reference is None:
        raise ConfigError(
            f"trust_remote_code: expected code named in {checkpoint / file}, got no {auto_class!r} "
            "in its auto_map; use the classes of a source tree instead: set source_dir"
        )
    return require("transformers.dynamic_module_utils").get_class_from_dynamic_module(
        class_reference, str(checkpoint)
    )


def find_source(source_dir: str | None) -> Path:
    """Find the folder that contains the package `prismatic`.

    Args:
        source_dir: The folder in the settings. With None, the function tries $OPENVLA_SRC,
            $OPENVLA_OFT_SRC and the folder of an installed `prismatic`.

    Raises:
        ConfigError: No folder contains the model's classes.
    """
    if source_dir:
        folders = [source_dir]
    else:
        folders = [os.environ[name] for name in VARIABLES if os.environ.get(name)]
    if not folders:
        spec = importlib.util.find_spec("prismatic")  # this finds the package without importing it
        if spec is not None:
            packages = spec.submodule_search_locations or ()
            folders = [str(Path(package).parent) for package in packages]

    for folder in folders:
        root = Path(folder).expanduser().resolve()
        if (root / "prismatic/extern/hf/modeling_prismatic.py").is_file():
            return root
    raise ConfigError(
        "OpenVLA's model classes: expected a folder with prismatic/extern/hf in it, got "
        f"{folders or 'no source tree'}; set source_dir or ${VARIABLES[0]} to a clone of openvla "
        "or openvla-oft, or, if you trust the Python code that lies beside the weights, "
        "trust_remote_code: true"
    )


@lru_cache(maxsize=4)
def _from_source(root: Path) -> tuple[Any, Any]:
    """Import the classes of the model and of its image processor from a source tree."""
    # The code of OpenVLA-OFT prints settings that do not apply here.
    with _bare_packages(root), contextlib.redirect_stdout(io.StringIO()):
        modeling = importlib.import_module("prismatic.extern.hf.modeling_prismatic")
        processing = importlib.import_module("prismatic.extern.hf.processing_prismatic")
    return getattr(modeling, MODEL), getattr(processing, PROCESSOR)


@contextlib.contextmanager
def _bare_packages(root: Path) -> Iterator[None]:
    """Import from `root` without running the `__init__` of the packages, which would import
    TensorFlow and other libraries.
    """
    earlier_modules = _remove_modules()
    for name in _PACKAGES:
        package = types.ModuleType(name)
        package.__path__ = [str(root.joinpath(*name.split(".")))]
        sys.modules[name] = package
    try:
        yield
    finally:
        # torch.compile imports the module of each compiled function by the module's name.
        alias = f"prismatic_{hashlib.sha256(str(root).encode()).hexdigest()[:16]}"
        for name, module in _remove_modules().items():
            module.__name__ = name.replace("prismatic", alias, 1)
            sys.modules[module.__name__] = module
        sys.modules.update(earlier_modules)


def _remove_modules() -> dict[str, types.ModuleType]:
    """Remove all modules of a package `prismatic` from `sys.modules`, and return them."""
    names = [name for name in sys.modules if name.partition(".")[0] == "prismatic"]
    return {name: sys.modules.pop(name) for name in names}


# The key in the options of a reset and in the info of an observation, as OpenVLA's clients send it.
UNNORM_KEY = "unnorm_key"
OFFERED = ("logprob", "entropy", "replay")  # outputs that are available for action tokens
_SINGLE_ARM = 7  # numbers of an action for one arm: six for the motion, one for the gripper


@dataclass(frozen=True, slots=True)
class PreparedRow:
    """A valid row, ready for the model."""

    row: Row
    scale: Scale  # scale of the actions in the row's dataset
    model_input: Any


class PrismaticPolicy(ModelPolicy):
    """The base of OpenVLA and OpenVLA-OFT.

    It computes all valid rows of a batch together. Each row has the units of its own dataset.
    """

    config: Any
    network = "model.base.network"
    variation = "prompts are padded to the longest one"

    @abc.abstractmethod
    def _model_input(self, row: Row, key: str) -> Any:
        """Return the model's input for a row of the dataset `key`.

        An error affects only this row.
        """

    @abc.abstractmethod
    def _compute(self, prepared: Sequence[PreparedRow]) -> list[Prediction]:
        """Compute all rows in one batch."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode; `kwargs` may contain `unnorm_key`, the dataset of its actions."""
        info = super().reset(obs, instruction, **kwargs)
        self._current_episode().memory[UNNORM_KEY] = self._requested_dataset(kwargs)
        return info

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """Compute the chunks of rows. The result of an invalid row is its error."""

        def prepare(row: Row) -> PreparedRow:
            key = self._dataset(row)
            scale = self._statistics.scale(key)
            return PreparedRow(row, scale, self._model_input(row, key))

        return compute_valid([attempt(prepare, row) for row in rows], self._compute)

    def _example(self, seed: int, instruction: str = "warm up") -> Row:
        """Return a row of any dataset, since sessions may select their datasets later."""
        row = super()._example(seed, instruction)
        key = self.config.unnorm_key or self._statistics.names[0]
        return replace(row, memory={UNNORM_KEY: key})

    def _decoded(
        self, bins: ActionBins, prepared: Sequence[PreparedRow], tokens: Any, bin_logits: Any
    ) -> list[Prediction]:
        """Return the chunks that the action tokens represent, with the outputs that the rows
        request.

        Args:
            bins: The bins of the checkpoint.
            prepared: The B rows of the batch.
            tokens: The chosen tokens, (B, H, D).
            bin_logits: The logits of the bins from which they were chosen, (B, H, D, bins).
        """
        described = bins.describe(tokens, bin_logits)
        predictions = []
        for i, entry in enumerate(prepared):
            scale = entry.scale
            values, mean, spread, logprob, entropy, chosen = described[:, i, :, : scale.dim]
            available = {
                "logprob": self._executed_rows(logprob),
                "entropy": float(self._executed_rows(entropy).sum()),
                "replay": {"tokens": chosen.astype(np.int64)},
            }
            prediction = Prediction(
                scale.restore(values),
                scale.restore(mean),
                scale.restore_spread(spread),
                {name: available[name] for name in entry.row.want},
            )
            predictions.append(prediction)
        return predictions

    @property
    def _statistics(self) -> Statistics:
        """The statistics of the datasets on which the loaded checkpoint was trained."""
        base: Prismatic = self.loaded().base
        return base.statistics

    def _requested_dataset(self, options: Mapping[str, Any]) -> str | None:
        """Return the key of the dataset that a client names in a reset or an observation; None if
        the client names no dataset.
        """
        name = options.get(UNNORM_KEY)
        if name is None:
            return None
        if not isinstance(name, str):
            raise InvalidObservation(
                f"unnorm_key: expected a dataset's name, got {type(name).__name__}"
            )
        return self._statistics.key(name)

    def _dataset(self, row: Row) -> str:
        """Return the key of a row's dataset.

        The dataset is named in the observation, the reset of the episode or the settings, in this
        order of priority. Otherwise, it is the only dataset.
        """
        name = (
            self._requested_dataset(row.info)
            or row.memory.get(UNNORM_KEY)
            or self.config.unnorm_key
        )
        return self._statistics.key(name)

    def _action(self) -> ActionSpec:
        """Describe an action.

        Its meaning depends on the dataset, except for the gripper of a single arm.
        """
        dims: set[int] = set()
        if self.model is not None:
            dims = self._statistics.action_dims(self.config.unnorm_key)
        dim = dims.pop() if len(dims) == 1 else None
        if dim == _SINGLE_ARM:
            return ActionSpec(dim=dim, gripper_open=1.0, gripper_closed=0.0)
        return ActionSpec(dim=dim)


SIDE = 224  # size of all images in OpenVLA's training data, px
CROP_AREA = 0.9  # share of the area that remains in the random crops of training
_LOBES = 3  # number of lobes of the Lanczos kernel


def resize(image: np.ndarray) -> np.ndarray:
    """Resize an image in the same way as the training data: JPEG compression with quality 95, then
    Lanczos.

    Args:
        image: (H, W, 3) uint8.

    Returns:
        (224, 224, 3) uint8, or the image itself if it already has this size.
    """
    height, width = image.shape[:2]
    if (height, width) == (SIDE, SIDE):
        return image
    pixels = _apply(_lanczos(height), _lanczos(width), _through_jpeg(image).astype(np.float32))
    return _uint8(np.round(pixels), 255)


def crop_center(image: np.ndarray) -> np.ndarray:
    """Crop the central nine tenths of the area of an image, and scale them up.

    Args:
        image: (H, W, 3) uint8.

    Returns:
        (224, 224, 3) uint8.
    """
    height, width = image.shape[:2]
    pixels = _apply(_crop(height), _crop(width), image.astype(np.float32) / 255)
    return _uint8(pixels * 255.5, 255.5)  # TensorFlow also adds a half and truncates


def _uint8(pixels: np.ndarray, upper: float) -> np.ndarray:
    """Clip pixels to [0, upper], and truncate them to integers."""
    return np.asarray(np.clip(pixels, 0, upper), np.uint8)


def _through_jpeg(image: np.ndarray) -> np.ndarray:
    """Compress and decompress the image with the algorithms that TensorFlow uses.

    Its encoder corresponds to Pillow's exact encoder, and its decoder to the fast decoder. The
    results of simplejpeg's encoder would differ by up to 18.
    """
    file = io.BytesIO()
    require("PIL.Image").fromarray(image).save(file, "JPEG", quality=95, subsampling="4:2:0")
    decoded: np.ndarray = simplejpeg.decode_jpeg(
        file.getvalue(), "RGB", fastdct=True, fastupsample=False
    )
    return decoded


def _apply(rows: np.ndarray, columns: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Resample an image, (H, W, 3), with weights of its rows, (224, H), and of its columns,
    (224, W).
    """
    resampled_rows = np.tensordot(rows, image, (1, 0))  # (224, W, 3)
    return np.asarray(np.tensordot(resampled_rows, columns, (1, 1)).transpose(0, 2, 1))


@lru_cache(maxsize=16)
def _lanczos(size: int) -> np.ndarray:
    """Return weights, (224, size), that resize one axis of an image.

    The kernels are wider if the image shrinks, to avoid aliasing.
    """
    scale = size / SIDE
    centres = (np.arange(SIDE) + 0.5) * scale  # position in pixels of the original image
    x = ((np.arange(size) + 0.5) - centres[:, None]) / max(scale, 1.0)
    weights = np.where(np.abs(x) < _LOBES, np.sinc(x) * np.sinc(x / _LOBES), 0.0)
    return np.asarray(weights / weights.sum(1, keepdims=True), np.float32)


@lru_cache(maxsize=16)
def _crop(size: int) -> np.ndarray:
    """Return weights, (224, size), that enlarge the centre, with linear interpolation between the
    two nearest pixels.
    """
    side = CROP_AREA**0.5
    start = (1 - side) / 2 * (size - 1)
    # Position in pixels of the original image.
    positions = start + np.arange(SIDE) * (side * (size - 1) / (SIDE - 1))
    distances = np.abs(np.arange(size) - positions[:, None])
    return np.asarray(np.maximum(0.0, 1.0 - distances), np.float32)
