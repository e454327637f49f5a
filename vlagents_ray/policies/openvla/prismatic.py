"""The model of both policies: a checkpoint in OpenVLA's format for transformers, and all its parts."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import io
import json
import os
import sys
import types
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.policies.base import ModelConfig
from vlagents_ray.policies.base.accelerator import ensure_torchvision, torch_device, torch_dtype
from vlagents_ray.policies.base.checkpoint import SavedTensors, find_checkpoint, require_loaded
from vlagents_ray.policies.openvla.statistics import Bounds, Statistics
from vlagents_ray.policies.token_cache import TokenCache
from vlagents_ray.registry import require

_NEEDS = ("config.json", "preprocessor_config.json", "tokenizer_config.json", "*.safetensors")
_SPACE = 29871  # Llama's token of an empty word, which is between "Out:" and the action in training
_PROMPT = "In: What action should the robot take to {}?\nOut:"
_PROMPT_V01 = (  # OpenVLA v0.1 was fine-tuned from Vicuna; upstream, too, recognises it by the checkpoint's name
    "A chat between a curious user and an artificial intelligence assistant. The assistant gives helpful, detailed, "
    "and polite answers to the user's questions. USER: What action should the robot take to {}? ASSISTANT:"
)


@dataclass(frozen=True)
class Prismatic:
    """A loaded checkpoint."""

    path: Path
    network: Any  # OpenVLAForActionPrediction, of which vision_backbone, projector and language_model are used
    tokenizer: Any
    processor: Any  # PrismaticImageProcessor
    bins: ActionBins
    statistics: Statistics
    prompt: str
    device: Any
    dtype: Any
    deterministic: bool  # whether longer prompts than that are refused
    padded_tokens: int  # the length to which shorter prompts are padded; 0: that of the longest one
    own: dict[str, Statistics] = field(default_factory=dict)  # of adapters that were trained on other datasets
    prompts: TokenCache[list[int]] = field(default_factory=lambda: TokenCache(_size), repr=False)

    def pixels(self, image: np.ndarray) -> Any:
        """Convert an (H, W, 3) uint8 image to an input of the checkpoint's backbones, (C, S, S) float32 on the CPU."""
        return self.processor.apply_transform(require("PIL.Image").fromarray(image))

    def tokens(self, instruction: str) -> list[int]:
        """Return the prompt for an instruction, which the caller must not change.

        Raises `InvalidObservation` if it is longer than in the model's training, or than all are padded to.
        """
        [ids] = self.prompts.of([instruction], self._tokenized)
        most = self.padded_tokens if self.deterministic else self.network.config.llm_max_length
        if len(ids) > most:
            raise InvalidObservation(f"instruction: got {len(ids)} tokens with the prompt, want {most} at most")
        return ids

    def _tokenized(self, instructions: Sequence[str]) -> list[list[int]]:
        prompts = [self.tokenizer(self.prompt.format(text.lower())).input_ids for text in instructions]
        return [ids if ids[-1] == _SPACE else [*ids, _SPACE] for ids in prompts]

    def to_device(self, arrays: Sequence[Any]) -> Any:
        """Stack tensors of one shape to a batch in the model's dtype; the copy to a GPU is asynchronous."""
        torch = require("torch")
        batch = torch.stack(list(arrays))
        if self.device.type == "cuda":
            batch = batch.pin_memory()
        return batch.to(self.device, self.dtype, non_blocking=True)

    def embed(self, tokens: Sequence[int]) -> Any:
        """Return the embeddings of tokens, (L, D)."""
        torch = require("torch")
        return self.network.get_input_embeddings()(torch.tensor(tokens, device=self.device))


def _size(ids: list[int]) -> int:
    return 36 * len(ids)  # 8 bytes in the list, 28 of the number


def load_prismatic(config: PrismaticConfig, bounds: Bounds = "q99") -> Prismatic:
    """Read and verify a checkpoint; raises `ConfigError`."""
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
    require_loaded(network, SavedTensors.of(path))
    return Prismatic(
        path=path,
        network=network.to(device).eval().requires_grad_(False),
        tokenizer=transformers.AutoTokenizer.from_pretrained(path),
        processor=processor_class.from_pretrained(path),
        bins=ActionBins(network.config, device),
        statistics=statistics,
        prompt=_PROMPT_V01 if "openvla-v01" in config.checkpoint else _PROMPT,
        device=device,
        dtype=dtype,
        padded_tokens=config.compiled_tokens if config.compile or config.deterministic else 0,
        deterministic=config.deterministic,
    )


class PrismaticConfig(ModelConfig):
    """Settings of both policies."""

    compiled_tokens: int = Field(
        default=64,
        ge=1,
        description="with `compile` or `deterministic`: tokens to which prompts are padded; longer ones run without "
        "compilation, or are refused",
    )
    unnorm_key: str | None = Field(
        default=None,
        description="dataset whose statistics turn answers into physical units, with or without `_no_noops`; unset: "
        "the checkpoint's only one, or the one that `reset` or an observation names",
    )
    source_dir: str | None = Field(
        default=None,
        description="a clone of openvla or openvla-oft, for the model's classes; unset: $OPENVLA_SRC, "
        "$OPENVLA_OFT_SRC, or an installed `prismatic`",
    )
    trust_remote_code: bool = Field(
        default=False,
        description="run the Python code that lies in the checkpoint's folder instead: whoever can write there, or in "
        "the hub's repository, can do on this machine whatever this process can",
    )
    attention: Literal["sdpa", "eager", "flash_attention_2"] = Field(
        default="sdpa", description="of the language model; flash_attention_2 needs the package flash-attn and a GPU"
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.trust_remote_code and self.source_dir:
            raise ValueError("source_dir and trust_remote_code: got both, want the model's classes from one of them")
        return self


class ActionBins:
    """The bins of [-1, 1], which are the last tokens of the vocabulary; the very last one is the lowest bin."""

    def __init__(self, config: Any, device: Any) -> None:
        torch = require("torch")
        edges = np.linspace(-1, 1, config.n_action_bins)
        middles = (edges[:-1] + edges[1:]) / 2
        self._first = config.text_config.vocab_size - config.pad_to_multiple_of - 1
        # there is one token more than bins
        self._middles = torch.tensor(np.append(middles, middles[-1]), device=device)
        self._tokens = self._first - torch.arange(config.n_action_bins, device=device)

    def choose(self, logits: Any, draws: Any) -> Any:
        """Return tokens (…) for logits (…, V): those of bins at given quantiles, or the likeliest tokens.

        A number of `draws` (…), in [0, 1), is the quantile of the distribution over bins; where it is NaN, the
        likeliest of all tokens is taken.
        """
        torch = require("torch")
        upto = self._over_bins(logits).cumsum(-1)
        drawn = (upto > (draws * upto[..., -1])[..., None]).int().argmax(-1)
        return torch.where(draws.isnan(), logits.argmax(-1), self._tokens[drawn])

    def values(self, tokens: Any) -> np.ndarray:
        """Return the values in [-1, 1]; a token that is not a bin counts as the nearest bin, as upstream."""
        bins = (self._first - tokens).clamp(0, len(self._middles) - 1)
        return np.asarray(self._middles[bins].cpu())

    def moments(self, logits: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and standard deviation (…) of the distribution over bins."""
        over = self._over_bins(logits)
        mean = over @ self._middles
        spread = (over * (self._middles - mean[..., None]) ** 2).sum(-1).sqrt()
        return np.asarray(mean.cpu()), np.asarray(spread.cpu())

    def logprob(self, tokens: Any, logits: Any) -> Any:
        """Return the log-probabilities (…) of tokens (…) among the bins, nats, differentiable in logits (…, V)."""
        over = logits[..., self._tokens].double().log_softmax(-1)
        return over.gather(-1, (self._first - tokens)[..., None])[..., 0]

    def stated(self, tokens: Any, logits: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the log-probabilities (…) of tokens of bins, and the entropies (…) of the distributions, nats."""
        entropy = require("torch").special.entr(self._over_bins(logits)).sum(-1)
        return np.asarray(self.logprob(tokens, logits).cpu()), np.asarray(entropy.cpu())

    def _over_bins(self, logits: Any) -> Any:
        return logits[..., self._tokens].double().softmax(-1)


MODEL, PROCESSOR = "OpenVLAForActionPrediction", "PrismaticImageProcessor"
VARIABLES = ("OPENVLA_SRC", "OPENVLA_OFT_SRC")  # either serves both policies: the used code is the same
_PACKAGES = ("prismatic", "prismatic.extern", "prismatic.extern.hf", "prismatic.training", "prismatic.vla")


def model_classes(checkpoint: Path, source_dir: str | None, trust_remote_code: bool) -> tuple[Any, Any]:
    """Return the classes of the model and of its image processor.

    With `trust_remote_code`, they are the classes that the checkpoint's files name: Python code that runs with all
    rights of this process. Otherwise they come from the source tree: `source_dir`, $OPENVLA_SRC, $OPENVLA_OFT_SRC, or
    an installed `prismatic`.

    Raises:
        ConfigError: There are no such classes.
    """
    if trust_remote_code:
        return (
            _remote(checkpoint, "config.json", "AutoModelForVision2Seq"),
            _remote(checkpoint, "preprocessor_config.json", "AutoImageProcessor"),
        )
    return _from_source(find_source(source_dir))


def _remote(checkpoint: Path, file: str, auto: str) -> Any:
    named = json.loads((checkpoint / file).read_text(encoding="utf-8")).get("auto_map", {}).get(auto)
    if named is None:
        raise ConfigError(
            f"trust_remote_code: {checkpoint / file} names no code (auto_map has no {auto!r}); "
            f"take the classes from a source tree instead: set source_dir"
        )
    return require("transformers.dynamic_module_utils").get_class_from_dynamic_module(named, str(checkpoint))


def find_source(source_dir: str | None) -> Path:
    """Return the folder that holds the package `prismatic`."""
    asked = [source_dir] if source_dir else [os.environ[name] for name in VARIABLES if os.environ.get(name)]
    if not asked:
        spec = importlib.util.find_spec("prismatic")  # finds without importing
        asked = [str(Path(found).parent) for found in (spec.submodule_search_locations or ())] if spec else []
    for folder in asked:
        root = Path(folder).expanduser().resolve()
        if (root / "prismatic/extern/hf/modeling_prismatic.py").is_file():
            return root
    raise ConfigError(
        f"OpenVLA's model classes: got {asked or 'no source tree'}, want a folder with prismatic/extern/hf in it; set "
        f"source_dir or ${VARIABLES[0]} to a clone of openvla or openvla-oft, or, if you trust the Python code that "
        f"lies beside the weights, trust_remote_code: true"
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
    """Import from `root` without the packages' own `__init__`, which import all of training's packages, TensorFlow
    too.
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
