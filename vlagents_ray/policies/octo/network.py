"""Octo's transformer and action head, as compiled functions of a batch."""

from __future__ import annotations

import importlib.util
import re
import sys
import types
from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.accelerator import jax_device
from vlagents_ray.policies.base.checkpoint import find_checkpoint, require_filled
from vlagents_ray.policies.base.model_code import remote_code, use_source
from vlagents_ray.policies.octo.config import OctoConfig
from vlagents_ray.policies.octo.specs import require_own_classes
from vlagents_ray.registry import require

PROPRIO = "proprio"  # Octo's name of the state vector
_FILES = ("config.json", "example_batch.msgpack", "dataset_statistics.json")
_HEADS = ("DiffusionActionHead", "MSEActionHead", "L1ActionHead", "ContinuousActionHead", "DiscreteActionHead")
_EPSILON = 1e-8  # added to a standard deviation by Octo's NormalizeProprio


def octo_model_class(source_dir: str | None) -> Any:
    """Import `octo.model.octo_model.OctoModel`, from a checkout if one is given."""
    use_source("octo", "OCTO_SRC", source_dir)
    if "dlimp" not in sys.modules and importlib.util.find_spec("dlimp") is None:
        # Octo's data loaders import it; the model uses only a constant of their module.
        stub: Any = types.ModuleType("dlimp")
        stub.DLataset = object
        sys.modules["dlimp"] = stub
    require("tensorflow").config.set_visible_devices([], "GPU")  # it resizes images only, and the memory is for JAX
    return require("octo.model.octo_model").OctoModel


class OctoNetwork:
    """The model of a loaded checkpoint."""

    def __init__(self, model: Any, device: Any) -> None:
        """Compile an `OctoModel`, and move its parameters to a device once."""
        jax = require("jax")
        self.model = model
        self.params = jax.device_put(model.params, device)
        self.head = model.module.heads["action"]
        self.window: int = model.example_batch["observation"]["timestep_pad_mask"].shape[1]
        self.longest: int = model.module.octo_transformer.max_horizon
        self._decode = jax.jit(self._decoded, static_argnames="dim")
        self._encode = jax.jit(self._encoded)

    @classmethod
    def load(cls, config: OctoConfig) -> OctoNetwork:
        """Read a checkpoint; raises `ConfigError` if it is incomplete, or names code that is not Octo's."""
        octo_model = octo_model_class(config.source_dir)
        folder, step = _folder_and_step(config.checkpoint, config.checkpoint_step)
        chosen = jax_device(config.device)
        if not config.trust_remote_code:
            require_own_classes(folder / _FILES[0])
        try:
            with remote_code(allowed=config.trust_remote_code):
                model = octo_model.load_pretrained(str(folder), step)
        except ConfigError:
            raise
        except (OSError, ValueError, KeyError) as error:
            raise ConfigError(
                f"checkpoint {folder}: Octo could not load it ({type(error).__name__}: {error}); is it complete, of "
                f"this version of Octo, and is its language encoder's tokenizer on the hub or in the cache?"
            ) from error
        network = cls(model, chosen)
        require_filled(model.params, network.shapes())
        if type(network.head).__name__ not in _HEADS:
            raise ConfigError(f"action head: got {type(network.head).__name__}, want one of {list(_HEADS)}")
        return network

    def shapes(self) -> Any:
        """Return the shapes of the model's parameters."""
        jax = require("jax")
        example = self.model.example_batch
        init = partial(self.model.module.init, train=False)
        observation, task = example["observation"], example["task"]
        key = jax.random.PRNGKey(0)
        return jax.eval_shape(init, key, observation, task, observation["timestep_pad_mask"])["params"]

    @cached_property
    def cameras(self) -> dict[str, tuple[int, int]]:
        """Return the height and width of each image that a tokenizer reads, by Octo's name."""
        found = self._read_by("ImageTokenizer", "obs_stack_keys", ("image_.*",))
        return {name: (shape[0], shape[1]) for name, shape in found.items() if name.startswith("image_")}

    @cached_property
    def proprio_dim(self) -> int | None:
        """Return the length of the state vector; None if no tokenizer reads it."""
        found = self._read_by("LowdimObsTokenizer", "obs_keys", ())
        return found[PROPRIO][0] if PROPRIO in found else None

    def statistics(self, dataset: str | None, part: str) -> dict[str, np.ndarray]:
        """Return the statistics of "action" or "proprio"; raises `ConfigError` if there are none."""
        have = self.model.dataset_statistics
        own = have if dataset is None else have.get(dataset, {})
        if part not in own:
            choices = sorted(name for name, value in have.items() if isinstance(value, Mapping) and part in value)
            raise ConfigError(
                f"dataset {dataset!r}: the checkpoint has no statistics of {part!r} for it, so its numbers have "
                f"no units; want {f'one of {choices}' if choices else 'a checkpoint with dataset_statistics.json'}"
                f"{', or none' if part in have else ''}"
            )
        return {name: np.asarray(values) for name, values in own[part].items()}

    def encode(self, observations: Mapping[str, np.ndarray], tasks: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Compute the inputs of the action head: tokens (B, W, N, E) and their mask (B, W, N)."""
        tokens, mask = self._encode(self.params, observations, tasks)
        return np.asarray(tokens), np.asarray(mask)

    def decode(self, tokens: np.ndarray, mask: np.ndarray, keys: np.ndarray, dim: int) -> np.ndarray:
        """Sample normalised actions (B, H, dim) with a random key for each row, (B, 2) uint32."""
        return np.asarray(self._decode(self.params, tokens, mask, keys, dim=dim))

    def _encoded(self, params: Any, observations: Any, tasks: Any) -> Any:
        pad_mask = observations["timestep_pad_mask"]
        outputs = self.model.module.apply(
            {"params": params}, observations, tasks, pad_mask, train=False, method="octo_transformer"
        )
        read = outputs[self.head.readout_key]
        return read.tokens, read.mask

    def _decoded(self, params: Any, tokens: Any, mask: Any, keys: Any, dim: int) -> Any:
        group = require("octo.model.components.base").TokenGroup
        head = self.model.module.bind({"params": params}).heads["action"]

        def alone(tokens: Any, mask: Any, key: Any) -> Any:
            read = {head.readout_key: group(tokens[None], mask[None])}
            return head.predict_action(read, train=False, rng=key, embodiment_action_dim=dim)[0]

        return require("jax").vmap(alone)(tokens, mask, keys)[..., :dim]

    def _read_by(self, tokenizer: str, setting: str, usual: tuple[str, ...]) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the parts of an observation that match the patterns of a kind of tokenizers."""
        specs = [s for s in self.model.config["model"]["observation_tokenizers"].values() if s["name"] == tokenizer]
        patterns = [pattern for spec in specs for pattern in spec["kwargs"].get(setting, usual)]
        return {
            name: tuple(array.shape[2:])
            for name, array in self.model.example_batch["observation"].items()
            if any(re.match(pattern, name) for pattern in patterns)
        }


def normalised_state(vector: np.ndarray, statistics: Mapping[str, np.ndarray]) -> np.ndarray:
    """Normalise the state, (P,) float32, as Octo's NormalizeProprio does."""
    scaled = (vector - statistics["mean"]) / (statistics["std"] + _EPSILON)
    return np.where(statistics.get("mask", True), scaled, vector).astype(np.float32)


def real_actions(actions: np.ndarray, statistics: Mapping[str, np.ndarray], normalization: str) -> np.ndarray:
    """Convert normalised actions (..., D) to the units of the data, float32, except those that the mask leaves out."""
    if normalization == "normal":
        scaled = actions * statistics["std"] + statistics["mean"]
    else:
        low, high = statistics["p01"], statistics["p99"]
        scaled = (actions + 1) * (high - low) / 2 + low
    return np.where(statistics.get("mask", True), scaled, actions).astype(np.float32)


def _folder_and_step(checkpoint: str, step: int | None) -> tuple[Path, int]:
    """Return the folder with the configuration and the step within it, by default the newest."""
    folder = find_checkpoint(checkpoint.removeprefix("hf://"), step)
    if folder.name.isdigit() and not (folder / _FILES[0]).exists():
        folder, step = folder.parent, int(folder.name)
    find_checkpoint(str(folder), needs=_FILES)
    steps = sorted(int(p.name) for p in folder.iterdir() if p.is_dir() and p.name.isdigit())
    if not steps:
        raise ConfigError(f"checkpoint {folder}: has no step, a folder with a number for a name; copy all of it")
    step = steps[-1] if step is None else step
    for part in (*_FILES, str(step)):  # the files of the weights; training adds other steps
        find_checkpoint(str(folder / part))
    return folder, step
