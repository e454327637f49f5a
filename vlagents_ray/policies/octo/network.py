"""Octo's transformer and action head, each one compiled function of a batch."""

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
from vlagents_ray.policies.base.source import use_source
from vlagents_ray.registry import require

PROPRIO = "proprio"  # Octo's only name for a state vector
_FILES = ("config.json", "example_batch.msgpack", "dataset_statistics.json")
_HEADS = ("DiffusionActionHead", "MSEActionHead", "L1ActionHead", "ContinuousActionHead", "DiscreteActionHead")
_EPSILON = 1e-8  # what Octo's NormalizeProprio adds to a standard deviation


def octo_model_class(source_dir: str | None) -> Any:
    """`octo.model.octo_model.OctoModel`."""
    use_source("octo", "OCTO_SRC", source_dir)
    if "dlimp" not in sys.modules and importlib.util.find_spec("dlimp") is None:
        # Octo's data loaders want it; the model imports their module for a constant and never calls it.
        stub: Any = types.ModuleType("dlimp")
        stub.DLataset = object
        sys.modules["dlimp"] = stub
    require("tensorflow").config.set_visible_devices([], "GPU")  # resizes images only; the memory is for JAX
    return require("octo.model.octo_model").OctoModel


class Network:
    """A loaded checkpoint."""

    def __init__(self, model: Any, device: Any) -> None:
        """`model` is an `OctoModel`; its parameters go to `device` once, not with every call."""
        jax = require("jax")
        self.model = model
        self.params = jax.device_put(model.params, device)
        self.head = model.module.heads["action"]
        self.window: int = model.example_batch["observation"]["timestep_pad_mask"].shape[1]
        self.longest: int = model.module.octo_transformer.max_horizon
        self._decode = jax.jit(self._decoded, static_argnames="dim")
        self._encode = jax.jit(self._encoded)

    @classmethod
    def load(cls, checkpoint: str, step: int | None, device: str, source_dir: str | None) -> Network:
        """Read a checkpoint; `ConfigError` if it is not whole or does not fill its model."""
        octo_model = octo_model_class(source_dir)
        folder, step = _folder_and_step(checkpoint, step)
        chosen = jax_device(device)
        try:
            model = octo_model.load_pretrained(str(folder), step)
        except (OSError, ValueError, KeyError) as error:
            raise ConfigError(
                f"checkpoint {folder}: Octo could not load it ({type(error).__name__}: {error}); is it whole, of this "
                f"version of Octo, and is its language encoder's tokenizer to be had from the hub or its cache?"
            ) from error
        network = cls(model, chosen)
        require_filled(model.params, network.shapes())
        if type(network.head).__name__ not in _HEADS:
            raise ConfigError(f"action head: got {type(network.head).__name__}, want one of {list(_HEADS)}")
        return network

    def shapes(self) -> Any:
        """The parameters that the model has, by shape."""
        jax = require("jax")
        example = self.model.example_batch
        init = partial(self.model.module.init, train=False)
        observation, task = example["observation"], example["task"]
        key = jax.random.PRNGKey(0)
        return jax.eval_shape(init, key, observation, task, observation["timestep_pad_mask"])["params"]

    @cached_property
    def cameras(self) -> dict[str, tuple[int, int]]:
        """Height and width of each image that a tokenizer reads, by Octo's name."""
        found = self._read_by("ImageTokenizer", "obs_stack_keys", ("image_.*",))
        return {name: (shape[0], shape[1]) for name, shape in found.items() if name.startswith("image_")}

    @cached_property
    def proprio_dim(self) -> int | None:
        """Length of the state vector, if a tokenizer reads one."""
        found = self._read_by("LowdimObsTokenizer", "obs_keys", ())
        return found[PROPRIO][0] if PROPRIO in found else None

    def statistics(self, dataset: str | None, part: str) -> dict[str, np.ndarray]:
        """Those of "action" or "proprio"; `ConfigError` where there are none."""
        have = self.model.dataset_statistics
        own = have if dataset is None else have.get(dataset, {})
        if part not in own:
            choices = sorted(name for name, value in have.items() if isinstance(value, Mapping) and part in value)
            raise ConfigError(
                f"dataset {dataset!r}: the checkpoint has no statistics of {part!r} for it, so its numbers mean "
                f"nothing; want {f'one of {choices}' if choices else 'a checkpoint with dataset_statistics.json'}"
                f"{', or none' if part in have else ''}"
            )
        return {name: np.asarray(values) for name, values in own[part].items()}

    def encode(self, observations: Mapping[str, np.ndarray], tasks: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """What the action head reads of each row: tokens (B, W, N, E) and their mask (B, W, N)."""
        tokens, mask = self._encode(self.params, observations, tasks)
        return np.asarray(tokens), np.asarray(mask)

    def decode(self, tokens: np.ndarray, mask: np.ndarray, keys: np.ndarray, dim: int) -> np.ndarray:
        """Normalised actions (B, H, dim), each row by its own key, (B, 2) uint32: as Octo samples it alone."""
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
        """Shapes of the parts of an observation that match the patterns of such tokenizers."""
        specs = [s for s in self.model.config["model"]["observation_tokenizers"].values() if s["name"] == tokenizer]
        patterns = [pattern for spec in specs for pattern in spec["kwargs"].get(setting, usual)]
        return {
            name: tuple(array.shape[2:])
            for name, array in self.model.example_batch["observation"].items()
            if any(re.match(pattern, name) for pattern in patterns)
        }


def normalised_state(vector: np.ndarray, statistics: Mapping[str, np.ndarray]) -> np.ndarray:
    """As Octo's NormalizeProprio does it, (P,) float32."""
    scaled = (vector - statistics["mean"]) / (statistics["std"] + _EPSILON)
    return np.where(statistics.get("mask", True), scaled, vector).astype(np.float32)


def real_actions(actions: np.ndarray, statistics: Mapping[str, np.ndarray], normalization: str) -> np.ndarray:
    """Normalised actions (..., D) in the units of the data, float32; what the mask leaves out is so already."""
    if normalization == "normal":
        scaled = actions * statistics["std"] + statistics["mean"]
    else:
        low, high = statistics["p01"], statistics["p99"]
        scaled = (actions + 1) * (high - low) / 2 + low
    return np.where(statistics.get("mask", True), scaled, actions).astype(np.float32)


def _folder_and_step(checkpoint: str, step: int | None) -> tuple[Path, int]:
    """The folder with the configuration, and the step within it, its newest if none is asked for."""
    folder = find_checkpoint(checkpoint.removeprefix("hf://"), step)
    if folder.name.isdigit() and not (folder / _FILES[0]).exists():
        folder, step = folder.parent, int(folder.name)
    find_checkpoint(str(folder), needs=_FILES)
    steps = sorted(int(p.name) for p in folder.iterdir() if p.is_dir() and p.name.isdigit())
    if not steps:
        raise ConfigError(f"checkpoint {folder}: has no step, a folder with a number for a name; copy all of it")
    return folder, steps[-1] if step is None else step
