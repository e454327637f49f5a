"""openpi's models for batches of rows: in JAX, with or without a flow, and in PyTorch."""

from __future__ import annotations

import abc
import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base import ModelConfig, Row
from vlagents_ray.policies.base.accelerator import jax_device, torch_device
from vlagents_ray.policies.base.checkpoint import SavedTensors, require_loaded
from vlagents_ray.policies.base.config import NoiseLevel
from vlagents_ray.policies.base.realtime import Guide
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import Change, RandomSteps
from vlagents_ray.policies.flow_passes import Pi0Passes
from vlagents_ray.policies.openpi.robots import Layout
from vlagents_ray.registry import require


class OpenPiConfig(ModelConfig):
    """Settings of openpi's policies, beside those of all models."""

    config: str = Field(
        min_length=1, description="the training config: one of openpi's names, such as pi05_libero, or 'module:NAME'"
    )
    checkpoint: str = Field(
        min_length=1, description="openpi's folder of a step, with params/ or model.safetensors, and assets/; or gs://…"
    )
    source_dir: str | None = Field(
        default=None, description="a checkout of openpi; unset: the variable OPENPI_SRC, or what is installed"
    )
    cameras: dict[str, str] | None = Field(
        default=None,
        description="openpi's keys of the images -> our cameras, a dot going one level down: images.cam_high; unset: "
        "those of the config's robot",
    )
    state: dict[str, dict[str, int]] | None = Field(  # type: ignore[assignment]  # openpi has several vectors, by key
        default=None,
        description="openpi's keys of the state -> the parts of ours that make up each, and how many numbers each has; "
        "'gripper' stands for `Obs.gripper`, 'gripper_closed' for 1 minus that; unset: those of the config's robot",
    )
    layout: Layout | None = Field(default=None, description="layout of the images for the transforms: hwc or chw")
    steps: int | None = Field(default=None, ge=1, description="steps of the flow (pi0, pi0.5); unset: openpi's, 10")
    max_decoding_steps: int = Field(default=256, ge=1, description="largest number of tokens of a chunk (pi0-FAST)")
    guidance: float = Field(default=5.0, gt=0, description="real-time chunking: largest weight of the old plan")
    noise_level: NoiseLevel = 0.0
    batch_sizes: list[int] | None = Field(
        default=None,
        description="the only numbers of rows to run; unset: for JAX or with `compile` those of the "
        "deployment's `batch`, else any",
    )


logger = logging.getLogger(__name__)

_STEPS = 10  # openpi's own default
_END = 1  # PaliGemma's end of sequence
_LISTED = 5


class OpenPiModel(abc.ABC):
    """The interface of a model for the policy."""

    noise_shape: tuple[int, int] | None = None  # (H, action_dim) of a row's noise; None for a model without noise
    shares = False  # whether several rows can be of one observation

    @abc.abstractmethod
    def sample(
        self,
        batch: dict[str, Any],
        noise: np.ndarray,
        guide: Guide | None,
        owners: Sequence[int],
        random: RandomSteps | None,
    ) -> np.ndarray:
        """Compute actions (B, H, action_dim), or tokens (B, T).

        Args:
            batch: The inputs of P observations.
            noise: That of each of the B rows.
            guide: Of the rows, if any follows a plan.
            owners: The observation of each row; 0, 1, … unless the model `shares`.
            random: The result of `random_steps` for the rows.
        """

    def random_steps(self, rows: Sequence[Row], noise_level: float) -> RandomSteps | None:
        """Return the random steps of rows of which something is wanted; None if there are none."""
        return None


class JaxFlow(OpenPiModel):
    """π0 and π0.5 in JAX, in two programs, each compiled once for each number of its rows.

    The first computes the keys and values of images and instruction, once for each observation. The second follows the
    flow of each row from them, with the steps of openpi's `sample_actions`.
    """

    shares = True

    def __init__(self, network: Any, device: Any, config: OpenPiConfig) -> None:
        jax, nnx, models = require("jax"), require("flax.nnx"), require("openpi.models.model")
        jnp, attention_mask = jax.numpy, require("openpi.models.pi0").make_attn_mask
        graph, self._state = nnx.split(network)
        self._device = device
        steps, limit = config.steps or _STEPS, config.guidance

        def encode(state: Any, batch: Any) -> Any:
            model = nnx.merge(graph, state)
            observation = models.preprocess_observation(None, _observation(batch), train=False)
            tokens, seen, causal = model.embed_prefix(observation)
            mask, places = attention_mask(seen, causal), jnp.cumsum(seen, axis=1) - 1
            _, (keys, values) = model.PaliGemma.llm([tokens, None], mask=mask, positions=places)
            return keys.swapaxes(0, 1), values.swapaxes(0, 1), seen, observation.state  # rows before layers

        def follow(state: Any, encoded: Any, noise: Any, guide: Any) -> Any:
            model, guide = nnx.merge(graph, state), Guide(*guide)
            keys, values, seen, proprio = encoded
            cache = keys.swapaxes(0, 1), values.swapaxes(0, 1)
            observation = models.Observation(images={}, image_masks={}, state=proprio)

            def step(now: Any) -> Any:
                actions, time = now
                tokens, mask, causal, condition = model.embed_suffix(
                    observation, actions, jnp.broadcast_to(time, len(noise))
                )
                before = jnp.broadcast_to(seen[:, None], (*tokens.shape[:2], seen.shape[1]))
                (_, hidden), _ = model.PaliGemma.llm(
                    [None, tokens],
                    mask=jnp.concatenate([before, attention_mask(mask, causal)], axis=-1),
                    positions=seen.sum(-1)[:, None] + jnp.cumsum(mask, axis=-1) - 1,
                    kv_cache=cache,
                    adarms_cond=[None, condition],
                )
                velocity = model.action_out_proj(hidden[:, -noise.shape[1] :])
                velocity = guide.steer(velocity, actions, noise, time, steps=steps, limit=limit, lower=jnp.minimum)
                return actions - velocity / steps, time - 1 / steps

            return jax.lax.while_loop(lambda now: now[1] >= 0.5 / steps, step, (noise, 1.0))[0]

        self._encode, self._follow = jax.jit(encode), jax.jit(follow)
        self.noise_shape = (network.action_horizon, network.action_dim)

    def sample(
        self,
        batch: dict[str, Any],
        noise: np.ndarray,
        guide: Guide | None,
        owners: Sequence[int],
        random: RandomSteps | None,
    ) -> np.ndarray:
        """Compute actions (B, H, action_dim) float32; a batch without plans runs the same program without guidance."""
        jax = require("jax")
        if guide is None:
            none = np.zeros((*noise.shape[:2], 1), np.float32)
            guide = Guide(np.zeros_like(noise), none, none)
        batch, noise, plan = jax.device_put((batch, noise, (guide.plan, guide.frozen, guide.weight)), self._device)
        encoded = self._encode(self._state, batch)
        if list(owners) != list(range(len(encoded[0]))):
            encoded = jax.tree.map(lambda one: one[np.asarray(owners)], encoded)
        return np.asarray(self._follow(self._state, encoded, noise, plan), np.float32)  # waits for the device


class JaxTokens(OpenPiModel):
    """π0-FAST in JAX, with greedy decoding and without noise."""

    def __init__(self, network: Any, device: Any, config: OpenPiConfig) -> None:
        jax, nnx = require("jax"), require("flax.nnx")
        graph, self._state = nnx.split(network)
        self._device = device
        most = config.max_decoding_steps

        def sample(state: Any, batch: Any) -> Any:
            model = nnx.merge(graph, state)
            return model.sample_actions(jax.random.key(0), _observation(batch), max_decoding_steps=most)

        self._sample = jax.jit(sample)

    def sample(
        self,
        batch: dict[str, Any],
        noise: np.ndarray,
        guide: Guide | None,
        owners: Sequence[int],
        random: RandomSteps | None,
    ) -> np.ndarray:
        """Decode tokens, (B, T) int32."""
        jax = require("jax")
        return self.ended(np.asarray(self._sample(self._state, jax.device_put(batch, self._device)), np.int32))

    @staticmethod
    def ended(tokens: np.ndarray) -> np.ndarray:
        """Replace the tokens (B, T) after the end of each row by zeros, as in a batch of one.

        openpi decodes until all rows have ended, and so continues rows of a batch after their end.
        """
        ends = tokens == _END
        return np.where(np.cumsum(ends, axis=1) - ends > 0, 0, tokens)


class TorchFlow(OpenPiModel):
    """openpi's PyTorch port of π0 and π0.5."""

    shares = True

    def __init__(self, network: Any, device: Any, config: OpenPiConfig, compilation: Compilation) -> None:
        self._network, self._device = network, device
        self._passes = Pi0Passes(network, compilation)
        self._steps, self._limit = config.steps or _STEPS, config.guidance
        self.noise_shape: tuple[int, int] = (network.config.action_horizon, network.config.action_dim)

    def sample(
        self,
        batch: dict[str, Any],
        noise: np.ndarray,
        guide: Guide | None,
        owners: Sequence[int],
        random: RandomSteps | None,
    ) -> np.ndarray:
        """Compute actions (B, H, action_dim) float32."""
        jax, torch = require("jax"), require("torch")
        observation = _observation(jax.tree.map(self._convert, batch))
        start, changes = self._convert(noise), list[Change]()
        if guide is not None:
            changes.append(guide.to(self._convert).change(start, steps=self._steps, limit=self._limit))
        if random is not None:
            changes.append(random.change)
        with torch.inference_mode():
            inputs = self._network._preprocess_observation(observation, train=False)
            flow = self._passes.sample(*inputs, noise=start, owners=owners, steps=self._steps, changes=changes)
        return np.asarray(flow.float().cpu().numpy())

    def random_steps(self, rows: Sequence[Row], noise_level: float) -> RandomSteps | None:
        return RandomSteps.of(rows, (self._steps, *self.noise_shape), noise_level, self._convert)

    def _convert(self, array: np.ndarray) -> Any:
        """Return a copy of the array as a tensor on the device."""
        return require("torch").from_numpy(np.array(array)).to(self._device, non_blocking=True)


def load_jax(config: Any, folder: Path, settings: OpenPiConfig) -> OpenPiModel:
    """Load a JAX model; raises `ConfigError` if a parameter of the model or of its fine-tuning is missing."""
    jax, models = require("jax"), require("openpi.models.model")
    device = jax_device({"cuda": "gpu"}.get(settings.device, settings.device))
    dtype = ("float32" if device.platform == "cpu" else "bfloat16") if settings.dtype == "auto" else settings.dtype
    params = models.restore_params(
        folder / "params",
        dtype=getattr(jax.numpy, dtype),
        sharding=jax.sharding.SingleDeviceSharding(device),
    )
    model = dataclasses.replace(config.model, dtype=dtype)
    try:
        network = model.load(params)
    except ValueError as error:
        raise ConfigError(
            f"checkpoint {folder}: does not fill the model of config {config.name!r} ({str(error)[:400]}); "
            f"choose the config that it was trained with"
        ) from error
    _require_used(params, network, folder, config.name)
    network.eval()
    if settings.noise_level:
        raise ConfigError(
            f"noise_level: got {settings.noise_level} for a JAX checkpoint, want 0, as its compiled loop has no random "
            f"steps; convert it to PyTorch with openpi's script, or leave it out"
        )
    kind = JaxTokens if config.model.model_type is models.ModelType.PI0_FAST else JaxFlow
    return kind(network, device, settings)


def load_torch(config: Any, folder: Path, settings: OpenPiConfig, compilation: Compilation) -> OpenPiModel:
    """Load a PyTorch model; raises `ConfigError` if transformers lacks openpi's patch, or a parameter is missing."""
    device = torch_device(settings.device)
    file = folder / "model.safetensors"
    chosen = settings.dtype if settings.dtype != "auto" else ("float32" if device.type == "cpu" else "bfloat16")
    model = dataclasses.replace(config.model, pytorch_compile_mode=None, dtype=chosen)
    config = dataclasses.replace(config, model=model)
    try:
        network = config.model.load_pytorch(config, str(file))
    except (ValueError, RuntimeError) as error:
        raise ConfigError(f"checkpoint {file}: {str(error)[:600]}") from error
    network.paligemma_with_expert.to_bfloat16_for_selected_params(chosen)
    require_loaded(network, SavedTensors.of(file))
    return TorchFlow(network.eval().requires_grad_(False).to(device), device, settings, compilation)


def _observation(batch: dict[str, Any]) -> Any:
    data = {**batch, "image": dict(batch["image"])}  # openpi writes into it
    return require("openpi.models.model").Observation.from_dict(data)


def _require_used(params: Any, network: Any, folder: Path, name: str) -> None:
    """Raise `ConfigError` if the model drops tensors of LoRA; other unused tensors of base checkpoints are logged."""
    flatten = require("flax.traverse_util").flatten_dict
    own = set(flatten(require("flax.nnx").state(network).to_pure_dict(), sep="/"))
    extra = sorted(set(flatten(params, sep="/")) - own)
    if any("lora" in key for key in extra):
        raise ConfigError(
            f"checkpoint {folder}: was fine-tuned by LoRA, which config {name!r} does not have: {extra[:_LISTED]}; "
            f"choose the config that it was trained with, such as pi0_libero_low_mem_finetune"
        )
    if extra:
        logger.warning("checkpoint %s: %d tensors have no place in the model: %s", folder, len(extra), extra[:_LISTED])
