"""π0, π0-FAST and π0.5 with Physical Intelligence's own code, openpi, in JAX or PyTorch."""

from __future__ import annotations

import abc
import dataclasses
import importlib
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, cast

import numpy as np
from pydantic import Field

from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.accelerator import jax_device, torch_device
from vlagents_ray.policies.base.checkpoint import (
    STEP,
    SavedTensors,
    find_checkpoint,
    require_loaded,
)
from vlagents_ray.policies.base.config import Guidance, NoiseLevel
from vlagents_ray.policies.base.model_inputs import (
    CLOSED,
    GRIPPER,
    camera_images,
    choose_cameras,
    state_vector,
)
from vlagents_ray.policies.base.staging import StagedRow, Staging
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import OFFERED, Guide, Velocity
from vlagents_ray.policies.outcomes import attempt
from vlagents_ray.registry import require
from vlagents_ray_models.attention_config import AttentionConfig
from vlagents_ray_models.model_code import use_source
from vlagents_ray_models.pi0_passes import Pi0Passes

Layout = Literal["hwc", "chw"]


@dataclass(frozen=True, slots=True)
class RobotConvention:
    """The mapping of an `Obs` to the inputs of openpi's transforms for a robot."""

    cameras: Mapping[str, str]  # openpi's key -> our camera
    # openpi's key -> parts of the robot's state and their lengths.
    state: Mapping[str, Mapping[str, int]]
    layout: Layout = "hwc"
    action: ActionSpec = field(default_factory=ActionSpec)
    optional: tuple[str, ...] = ()  # cameras that openpi masks if they are missing

    def read(self, obs: Obs) -> dict[str, Any]:
        """Convert an observation to openpi's form, without the prompt.

        Args:
            obs: The observation.

        Returns:
            Copies of the images, uint8 in the convention's layout, and the state's vectors,
            float32, under openpi's keys. A dot in a key means a nested dict.
        """
        data: dict[str, Any] = {}
        for key, image in camera_images(obs, self.cameras).items():
            _put(data, key, np.array(image if self.layout == "hwc" else image.transpose(2, 0, 1)))
        for key, parts in self.state.items():
            _put(data, key, state_vector(obs, list(parts), sum(parts.values())))
        return data


def _put(data: dict[str, Any], key: str, value: np.ndarray) -> None:
    """Store a value under a key. Dots separate the keys of nested dicts."""
    *outer_keys, last_key = key.split(".")
    for outer_key in outer_keys:
        data = data.setdefault(outer_key, {})
    data[last_key] = value


_ALOHA = RobotConvention(
    {
        "images.cam_high": "front",
        "images.cam_left_wrist": "left_wrist",
        "images.cam_right_wrist": "right_wrist",
    },
    {"state": {"left/joints": 6, "left/gripper": 1, "right/joints": 6, "right/gripper": 1}},
    "chw",
    ActionSpec(dim=14, gripper_open=1.0, gripper_closed=0.0, arms=("left", "right")),
    optional=("images.cam_left_wrist", "images.cam_right_wrist"),
)

# Class of openpi's observation transform -> convention, as in openpi's
# examples/{libero,droid,aloha_real,aloha_sim}. In actions of LIBERO and DROID, 1 closes the
# gripper; in DROID's observations, 0 is open. ALOHA's two grippers, numbers 6 and 13, are in [0,
# 1], where 1 is open, and stay unchanged.
ROBOTS: Mapping[str, RobotConvention] = {
    "LiberoInputs": RobotConvention(
        {"observation/image": "front", "observation/wrist_image": "wrist"},
        {"observation/state": {"xyz_axis_angle": 6, "gripper_qpos": 2}},
        action=ActionSpec(dim=7, delta=True, gripper_open=-1.0, gripper_closed=1.0),
    ),
    "DroidInputs": RobotConvention(
        {"observation/exterior_image_1_left": "front", "observation/wrist_image_left": "wrist"},
        {
            "observation/joint_position": {"joints": 7},
            "observation/gripper_position": {"gripper_closed": 1},
        },
        action=ActionSpec(dim=8, gripper_open=0.0, gripper_closed=1.0),
    ),
    "AlohaInputs": _ALOHA,
}
_QUANTILES = ("q01", "q99")  # statistics with which a robot's values are compared with the training


def choose_robot(config: str, transform: str, settings: OpenPiConfig) -> RobotConvention:
    """Return the convention of a robot.

    Args:
        config: The name of the training config.
        transform: The class of its observation transform.
        settings: The settings of the policy, which override the usual convention.

    Raises:
        ConfigError: The robot is unknown, and the settings do not describe it.
    """
    cameras, state = settings.cameras, settings.state
    usual = ROBOTS.get(transform)
    if usual is None:
        if cameras is None or state is None:
            raise ConfigError(
                f"config {config!r}: expected a transform of {sorted(ROBOTS)} for its "
                f"observations, got {transform or 'none'}; choose another config, or give its "
                "keys, as in cameras: {KEY: front}, state: {KEY: {joints: 7}}"
            )
        usual = RobotConvention(cameras, {})
    if cameras is None and config == "pi0_aloha_sim":
        cameras = {"images.cam_high": "front"}  # The simulation has only one camera.

    used_keys = []
    for key in usual.cameras:
        is_left_out = key in usual.optional and cameras is not None and key not in cameras
        if not is_left_out:
            used_keys.append(key)
    return replace(
        usual,
        cameras=choose_cameras(cameras, usual.cameras, used_keys),
        state=usual.state if state is None else state,
        layout=settings.layout or usual.layout,
    )


@dataclass(frozen=True)
class Transforms:
    """The transforms of a checkpoint with its statistics, in the order of openpi's
    `create_trained_policy`.
    """

    # A transform from a dict of unbatched arrays to the model's inputs. `outputs` and `forward` are
    # also transforms of dicts.
    inputs: Any
    outputs: Any
    forward: Any  # part of `inputs` that converts actions, before the model's own transforms
    # The lowest and highest values of "state" and "actions" in training, (D,), in the units of
    # `forward`; empty if the checkpoint has none.
    bounds: Sequence[Mapping[str, np.ndarray]]
    robot: str  # class of the first observation transform, e.g. "LiberoInputs"
    needs_prompt: bool  # False if the config has a prompt

    @classmethod
    def from_folder(cls, config: Any, folder: Path) -> Transforms:
        """Read the transforms of a checkpoint.

        Args:
            config: openpi's training config.
            folder: The folder of the checkpoint.

        Raises:
            ConfigError: The checkpoint lacks statistics of the config's asset.
        """
        openpi = require("openpi.transforms")
        # Only the checkpoint's statistics are used. openpi itself would first search online.
        assets = dataclasses.replace(config.data.assets, assets_dir=str(folder / "assets"))
        data_factory = dataclasses.replace(config.data, assets=assets)
        data = data_factory.create(config.assets_dirs, config.model)

        statistics = _read_statistics(folder, data.asset_id)
        quantiles = data.use_quantile_norm
        try:
            normalise = openpi.Normalize(statistics, use_quantiles=quantiles)
            restore = openpi.Unnormalize(statistics, use_quantiles=quantiles)
        except ValueError as error:
            raise ConfigError(
                f"checkpoint {folder}: {error}; compute its statistics with openpi's script"
            ) from error

        robot, model = data.data_transforms, data.model_transforms
        default_prompts = []
        for transform in model.inputs:
            if isinstance(transform, openpi.InjectDefaultPrompt):
                default_prompts.append(getattr(transform, "prompt", None))
        return cls(
            inputs=openpi.compose([*robot.inputs, normalise, *model.inputs]),
            outputs=openpi.compose([*model.outputs, restore, *robot.outputs]),
            forward=openpi.compose([*robot.inputs, normalise]),
            bounds=[normalise(quantiles) for quantiles in _quantiles(statistics)],
            robot=type(robot.inputs[0]).__name__ if robot.inputs else "",
            needs_prompt=not any(default_prompts),
        )

    def read(self, observation: dict[str, Any], instruction: str) -> dict[str, Any]:
        """Convert an observation to the model's inputs.

        Args:
            observation: The result of `RobotConvention.read`.
            instruction: The task in words.

        Returns:
            The inputs of one row, by openpi's names.

        Raises:
            InvalidObservation: The instruction may be too long for the model.
        """
        inputs: dict[str, Any] = self.inputs(_with_prompt(observation, instruction))
        mask = np.asarray(inputs["tokenized_prompt_mask"])
        if mask.all():
            raise InvalidObservation(
                f"instruction: it fills all {mask.size} tokens of the model, so that its end may "
                "be cut off; shorten it"
            )
        return inputs

    def actions(self, state: np.ndarray, output: np.ndarray) -> np.ndarray:
        """Convert the model's output to actions in the robot's units.

        Args:
            state: The state of the row's inputs.
            output: The model's output for the row: actions (H, action_dim), or tokens (T,).

        Returns:
            The actions, (H, D) float32.
        """
        return np.asarray(self.outputs({"state": state, "actions": output})["actions"], np.float32)

    def plan(
        self, observation: dict[str, Any], instruction: str, actions: np.ndarray
    ) -> np.ndarray:
        """Convert planned actions of a robot to the model's units.

        Args:
            observation: The result of `RobotConvention.read`.
            instruction: The task in words.
            actions: The actions in the robot's units, (H, D).

        Returns:
            The actions, (H, action_dim) float32. They are relative to the observation if the
            model's actions are.
        """
        data = _with_prompt(observation, instruction) | {"actions": np.array(actions)}
        return np.asarray(self.forward(data)["actions"], np.float32)

    def ranges(self, robot: RobotConvention) -> dict[str, Any] | None:
        """Return `HasStatistics.statistics` in the robot's units.

        openpi computes its statistics from transformed numbers: the sign of some of ALOHA's joints
        changes, and most actions are relative to the state. This method transforms random numbers
        to find out which of the robot's numbers are only multiplied by a factor and shifted by an
        offset.

        Args:
            robot: The convention of the robot.

        Returns:
            The statistics, with None for numbers that `forward` changes in another way; None if
            the checkpoint has no quantiles, or the robot's actions have no known length.
        """
        action_dim = robot.action.dim
        if not self.bounds or action_dim is None:
            return None
        state_dim = sum(sum(parts.values()) for parts in robot.state.values())
        dims = {"state": state_dim, "actions": action_dim}

        # Zeros show the offsets, the first random sample shows the factors, and the second sample
        # checks them.
        rng = np.random.default_rng(0)
        samples, transformed = [], []
        for scale in (0, 1, 1):
            sample = {name: scale * rng.uniform(0.2, 0.8, dim) for name, dim in dims.items()}
            samples.append(sample)
            transformed.append(self._transform(robot, sample["state"], sample["actions"]))

        ranges: dict[str, Any] = {"parts": []}
        for parts in robot.state.values():
            ranges["parts"] += parts
        for name, key in (("state", "observation.state"), ("actions", "action")):
            dim = dims[name]
            offset, first, second = (np.ravel(data[name])[:dim] for data in transformed)
            factor = (first - offset) / samples[1][name]
            predicted = offset + factor * samples[2][name]
            is_scaled = np.isclose(second, predicted, atol=1e-4) & (factor != 0)
            factor[~is_scaled] = np.nan

            bounds = [(bound[name][:dim] - offset) / factor for bound in self.bounds]
            lower, upper = np.sort(bounds, axis=0)  # a negative factor swaps the bounds
            ranges[key] = {
                _QUANTILES[0]: _none_for_nan(lower),
                _QUANTILES[1]: _none_for_nan(upper),
            }
        return ranges

    def _transform(
        self, robot: RobotConvention, state: np.ndarray, action: np.ndarray
    ) -> dict[str, Any]:
        """Return the result of `forward` for a state (D,), an action (D,) and black images."""
        # `forward` may change arrays in place, so copies are passed.
        data: dict[str, Any] = {"actions": np.array(action, ndmin=2)}
        image_shape = (224, 224, 3) if robot.layout == "hwc" else (3, 224, 224)
        for key in robot.cameras:
            _put(data, key, np.zeros(image_shape, np.uint8))

        widths = [sum(parts.values()) for parts in robot.state.values()]
        vectors = np.split(np.array(state), np.cumsum(widths)[:-1])
        for key, vector in zip(robot.state, vectors, strict=True):
            _put(data, key, vector)
        transformed: dict[str, Any] = self.forward(data)
        return transformed


def _none_for_nan(values: np.ndarray) -> list[float | None]:
    return [None if np.isnan(value) else value for value in values.tolist()]


def _with_prompt(observation: dict[str, Any], instruction: str) -> dict[str, Any]:
    """Return a copy of an observation with its prompt.

    The copy is as deep as openpi's transforms modify it.
    """
    data: dict[str, Any] = require("jax").tree.map(np.array, observation)
    return data | {"prompt": instruction} if instruction else data


def _quantiles(statistics: Mapping[str, Any]) -> list[dict[str, np.ndarray]]:
    """Return `_QUANTILES` of "state" and "actions", one dict each; empty if one is missing."""
    quantiles = []
    for quantile in _QUANTILES:
        values = {name: getattr(norm_stats, quantile) for name, norm_stats in statistics.items()}
        if any(value is None for value in values.values()):
            return []
        quantiles.append(values)
    return quantiles


def _read_statistics(folder: Path, asset: str | None) -> Any:
    """Return openpi's statistics of "state" and "actions" for an asset of a checkpoint."""
    if asset is None:
        raise ConfigError(
            "config: expected an asset_id, which names its statistics, got none; set one"
        )

    assets = folder / "assets"
    try:
        statistics = require("openpi.shared.normalize").load(assets / asset)
    except FileNotFoundError as error:
        files = assets.glob("**/norm_stats.json")
        available = sorted(str(file.parent.relative_to(assets)) for file in files)
        raise ConfigError(
            f"checkpoint {folder}: no assets/{asset}/norm_stats.json, has those of {available}; "
            "without statistics a policy's actions have no units: copy them there, or choose the "
            "config of its training"
        ) from error
    absent = sorted({"state", "actions"} - set(statistics))
    if absent:
        raise ConfigError(
            f"checkpoint {folder}: expected {absent} in assets/{asset}/norm_stats.json, got "
            f"{sorted(statistics)}"
        )
    return statistics


class OpenPiConfig(AttentionConfig):
    """Settings of openpi's policies, in addition to the settings of all models."""

    config: str = Field(
        min_length=1,
        description="the training config: one of openpi's names, such as pi05_libero, or "
        "'module:NAME'",
    )
    checkpoint: str = Field(
        min_length=1,
        description="openpi's folder of a step, with params/ or model.safetensors, and assets/; or "
        "gs://…",
    )
    source_dir: str | None = Field(
        default=None,
        description="a checkout of openpi; unset: the one that the variable OPENPI_SRC names, or "
        "the installed one",
    )
    cameras: dict[str, str] | None = Field(
        default=None,
        description="openpi's keys of the images -> our cameras, where a dot leads one level down: "
        "images.cam_high; unset: as usual for the config's robot",
    )
    state: dict[str, dict[str, int]] | None = Field(  # type: ignore[assignment]  # openpi has several vectors, by key
        default=None,
        description="openpi's keys of the state -> the parts of ours that make up each, and how "
        "many numbers each has; 'gripper' stands for `Obs.gripper`, 'gripper_closed' for 1 minus "
        "that; unset: as usual for the config's robot",
    )
    layout: Layout | None = Field(
        default=None, description="layout of the images for the transforms: hwc or chw"
    )
    steps: int | None = Field(
        default=None, ge=1, description="steps of the flow (pi0, pi0.5); unset: openpi's, 10"
    )
    guidance: Guidance = 5.0
    noise_level: NoiseLevel = 0.0


logger = logging.getLogger(__name__)

_STEPS = 10  # default of openpi
_MOST_TOKENS = 256  # tokens of a chunk of π0-FAST, as in openpi
_END = 1  # PaliGemma's end-of-sequence token
_LISTED = 5  # largest number of names in a message


@dataclass(frozen=True, slots=True)
class SampleBatch:
    """The inputs of a model for B chunks."""

    inputs: dict[str, Any]  # stacked inputs of P observations, from `OpenPiModel.stack`
    rows: Sequence[Row]  # B rows, with plans in the model's units
    noise: np.ndarray  # (B, H, action_dim) float32
    # Index of the observation of each row, from `ModelPolicy.observations_of`.
    owners: Sequence[int]
    dim: int | None  # number of values of an action that the robot uses


class OpenPiModel(abc.ABC):
    """The interface between a model and the policy."""

    # The shape of a row's noise, (H, action_dim); None for a model without noise.
    noise_shape: tuple[int, int] | None = None
    shares = False  # whether several rows can share one observation
    # The weights that a learner trains: a torch module, or nested dicts of JAX arrays.
    trained: Any

    def merge_products(self) -> None:
        """Merge products, see `ModelPolicy.merge_products`.

        JAX's compiler merges them by itself.
        """
        return

    def stage(self, inputs: dict[str, Any]) -> dict[str, Any]:
        """Return the inputs of an observation for the session.

        If the model can read inputs from the device, begin to copy them to it. Several threads may
        call it.
        """
        return inputs

    def stack(self, inputs: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """Return the stacked inputs of several observations, each a result of `stage`."""
        stacked: dict[str, Any] = require("jax").tree.map(lambda *leaves: np.stack(leaves), *inputs)
        return stacked

    @abc.abstractmethod
    def sample(self, batch: SampleBatch) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
        """Compute the chunks of a batch.

        Args:
            batch: The inputs.

        Returns:
            Actions (B, H, action_dim) float32, or tokens (B, T) int32; and a mapping from the index
            of each row that requests outputs to the values of these outputs.
        """


def pull_back_in_jax(
    velocity: Velocity, actions: Any, time: Any, error: Callable[[Any], Any]
) -> tuple[Any, Any]:
    """Multiply an error by the transposed Jacobian of a flow in JAX, as
    `vlagents_ray.policies.flow.pull_back` does in torch.
    """

    def expected_actions(noisy: Any) -> tuple[Any, Any]:
        taken = velocity(noisy)
        return noisy - time * taken, taken

    expected, pull, taken = require("jax").vjp(expected_actions, actions, has_aux=True)
    [correction] = pull(error(expected))
    return taken, correction


class JaxFlow(OpenPiModel):
    """π0 and π0.5 in JAX, as two programs, each compiled once per number of rows.

    The first program computes the keys and values of images and instruction, once for each
    observation. From these, the second program integrates the flow of each row, with the same steps
    as openpi's `sample_actions`.
    """

    shares = True

    def __init__(self, network: Any, device: Any, config: OpenPiConfig) -> None:
        """Prepare the programs of openpi's model on a device."""
        jax = require("jax")
        models = require("openpi.models.model")
        make_attention_mask = require("openpi.models.pi0").make_attn_mask
        jnp = jax.numpy
        self.trained, merge = _split(network)
        self._device = device
        steps = config.steps or _STEPS
        limit = min(config.guidance, float(steps))

        def encode(params: Any, batch: Any) -> Any:
            model = merge(params)
            observation = models.preprocess_observation(None, _observation(batch), train=False)
            tokens, present, causal = model.embed_prefix(observation)
            mask = make_attention_mask(present, causal)
            positions = jnp.cumsum(present, axis=1) - 1
            _, (keys, values) = model.PaliGemma.llm([tokens, None], mask=mask, positions=positions)
            # The first dimension is the rows, not the layers, so that `gather` can select rows.
            return keys.swapaxes(0, 1), values.swapaxes(0, 1), present, observation.state

        def follow(params: Any, encoded: Any, noise: Any, guide: Any) -> Any:
            model, guide = merge(params), Guide(*guide)
            keys, values, prefix_present, proprio = encoded
            prefix_lengths = prefix_present.sum(-1)[:, None]
            cache = keys.swapaxes(0, 1), values.swapaxes(0, 1)
            observation = models.Observation(images={}, image_masks={}, state=proprio)

            def velocity_at(actions: Any, time: Any) -> Any:
                times = jnp.broadcast_to(time, len(noise))
                tokens, present, causal, condition = model.embed_suffix(observation, actions, times)
                prefix_mask = jnp.broadcast_to(
                    prefix_present[:, None], (*tokens.shape[:2], prefix_present.shape[1])
                )
                suffix_mask = make_attention_mask(present, causal)
                (_, hidden), _ = model.PaliGemma.llm(
                    [None, tokens],
                    mask=jnp.concatenate([prefix_mask, suffix_mask], axis=-1),
                    positions=prefix_lengths + jnp.cumsum(present, axis=-1) - 1,
                    kv_cache=cache,
                    adarms_cond=[None, condition],
                )

                return model.action_out_proj(hidden[:, -noise.shape[1] :])

            def guided_velocity(actions: Any, time: Any) -> Any:
                return guide.steer(
                    lambda noisy: velocity_at(noisy, time),
                    actions,
                    time,
                    limit=limit,
                    lower=jnp.minimum,
                    pull=pull_back_in_jax,
                )

            is_guided = (guide.frozen + guide.weight).any()

            def step(carry: Any) -> Any:
                actions, time = carry
                # The gradient is computed only if a chunk is guided.
                velocity = jax.lax.cond(is_guided, guided_velocity, velocity_at, actions, time)
                return actions - velocity / steps, time - 1 / steps

            def is_unfinished(carry: Any) -> Any:
                _, time = carry
                return time >= 0.5 / steps

            actions, _ = jax.lax.while_loop(is_unfinished, step, (noise, 1.0))
            return actions

        def gather(encoded: Any, owners: Any) -> Any:
            return jax.tree.map(lambda array: array[owners], encoded)

        self._encode = jax.jit(encode)
        # `gather` is compiled for each pair of a number of observations and a number of rows. It
        # compiles quickly, while `follow` would take minutes for each pair.
        self._gather = jax.jit(gather)
        self._follow = jax.jit(follow)
        self.noise_shape = (network.action_horizon, network.action_dim)

    def sample(self, batch: SampleBatch) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
        """Compute actions (B, H, action_dim) float32. A batch without plans runs the same
        program, without guidance.
        """
        guide = Guide.for_rows(batch.rows, *batch.noise.shape[1:])
        if guide is None:
            zeros = np.zeros((*batch.noise.shape[:2], 1), np.float32)
            guide = Guide(np.zeros_like(batch.noise), zeros, zeros)
        guide_arrays = (guide.plan, guide.frozen, guide.weight)
        arrays = (batch.inputs, np.asarray(batch.owners), batch.noise, guide_arrays)
        inputs, owners, noise, device_guide = require("jax").device_put(arrays, self._device)

        encoded = self._encode(self.trained, inputs)
        if len(encoded[0]) < len(owners):
            encoded = self._gather(encoded, owners)
        actions = self._follow(self.trained, encoded, noise, device_guide)
        return np.asarray(actions, np.float32), {}  # the conversion waits for the device


class JaxTokens(OpenPiModel):
    """π0-FAST in JAX, with greedy decoding and without noise."""

    def __init__(self, network: Any, device: Any, config: OpenPiConfig) -> None:
        """Prepare the program of openpi's model on a device."""
        jax = require("jax")
        self.trained, merge = _split(network)
        self._device = device

        def sample(params: Any, batch: Any) -> Any:
            return merge(params).sample_actions(
                jax.random.key(0),
                _observation(batch),
                max_decoding_steps=_MOST_TOKENS,
            )

        self._sample = jax.jit(sample)

    def sample(self, batch: SampleBatch) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
        """Compute tokens (B, T) int32."""
        inputs = require("jax").device_put(batch.inputs, self._device)
        tokens = self._sample(self.trained, inputs)
        return self.ended(np.asarray(tokens, np.int32)), {}

    @staticmethod
    def ended(tokens: np.ndarray) -> np.ndarray:
        """Set the tokens (B, T) after each row's end to zero: openpi decodes until all rows have
        ended.
        """
        ends = tokens == _END
        return np.where(np.cumsum(ends, axis=1) - ends > 0, 0, tokens)


_SEPARATOR = "/"  # separates the keys of nested inputs in the names of staged arrays


class TorchFlow(OpenPiModel):
    """openpi's PyTorch port of π0 and π0.5."""

    shares = True

    def __init__(
        self, network: Any, device: Any, config: OpenPiConfig, compilation: Compilation
    ) -> None:
        """Prepare the forward passes of openpi's model, which is already on the device."""
        self.trained = network
        self._staging = Staging(device)
        self._config = config
        self._passes = Pi0Passes(network, compilation)
        self._passes.use_attention(config.attention)
        self.noise_shape = (network.config.action_horizon, network.config.action_dim)

    def stage(self, inputs: dict[str, Any]) -> dict[str, Any]:
        flat = require("flax.traverse_util").flatten_dict(inputs, sep=_SEPARATOR)
        return self._staging.stage({name: np.asarray(array) for name, array in flat.items()})

    def stack(self, inputs: Sequence[dict[str, Any]]) -> dict[str, Any]:
        stacked = self._staging.stack(cast(Sequence[StagedRow], inputs))
        unflatten = require("flax.traverse_util").unflatten_dict
        tensors: dict[str, Any] = unflatten(stacked, sep=_SEPARATOR)
        return tensors

    def sample(self, batch: SampleBatch) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
        """Compute actions, (B, H, action_dim) float32, and the requested outputs."""
        observation = _observation(batch.inputs)
        with require("torch").inference_mode():
            return self._passes.chunks(
                batch.rows,
                self.trained._preprocess_observation(observation, train=False),
                batch.owners,
                noise=batch.noise,
                steps=self._config.steps or _STEPS,
                config=self._config,
                dim=batch.dim,
                convert=self._convert,
            )

    def merge_products(self) -> None:
        self._passes.merge_products()

    def _convert(self, array: np.ndarray) -> Any:
        """Return a copy of the array as a tensor on the device."""
        return self._staging.upload(np.array(array))


def _split(network: Any) -> tuple[dict[str, Any], Callable[[Any], Any]]:
    """Return the parameters of a JAX model as nested dicts with openpi's names, and a function that
    makes the model from such dicts.
    """
    jax, nnx = require("jax"), require("flax.nnx")
    graph, state = nnx.split(network)
    # The leaves of the state and of the dicts have the same order, since both sort their keys.
    structure = jax.tree.structure(state)

    def merge(params: Any) -> Any:
        return nnx.merge(graph, jax.tree.unflatten(structure, jax.tree.leaves(params)))

    return state.to_pure_dict(), merge


def load_jax(config: Any, folder: Path, settings: OpenPiConfig) -> OpenPiModel:
    """Load a JAX model.

    Args:
        config: openpi's training config.
        folder: The folder of the checkpoint.
        settings: The settings of the policy.

    Raises:
        ConfigError: A parameter of the model or of its fine-tuning is missing, or the settings
            request random steps.
    """
    jax, models = require("jax"), require("openpi.models.model")
    device = jax_device({"cuda": "gpu"}.get(settings.device, settings.device))
    dtype = _dtype(settings, on_cpu=device.platform == "cpu")
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
            f"checkpoint {folder}: does not fill the model of config {config.name!r} "
            f"({str(error)[:400]}); choose the config that it was trained with"
        ) from error
    _require_used(params, network, folder, config.name)
    network.eval()

    if settings.noise_level:
        raise ConfigError(
            "noise_level: expected 0 for a JAX checkpoint, whose compiled loop has no random "
            f"steps, got {settings.noise_level}; convert it to PyTorch with openpi's script, or "
            "leave it out"
        )
    is_fast = config.model.model_type is models.ModelType.PI0_FAST
    model_class = JaxTokens if is_fast else JaxFlow
    return model_class(network, device, settings)


def load_torch(
    config: Any, folder: Path, settings: OpenPiConfig, compilation: Compilation
) -> OpenPiModel:
    """Load a PyTorch model.

    Args:
        config: openpi's training config.
        folder: The folder of the checkpoint.
        settings: The settings of the policy.
        compilation: The compilation of the policy.

    Raises:
        ConfigError: transformers lacks openpi's patch, or a parameter is missing.
    """
    device = torch_device(settings.device)
    file = folder / "model.safetensors"
    dtype = _dtype(settings, on_cpu=device.type == "cpu")
    # In bfloat16, the network keeps some parameters in float32, such as the parameters of its
    # norms. openpi calls `to_bfloat16_for_selected_params` again after loading, which also rounds
    # these parameters.
    model = dataclasses.replace(config.model, pytorch_compile_mode=None, dtype=dtype)
    config = dataclasses.replace(config, model=model)
    try:
        network = config.model.load_pytorch(config, str(file))
    except (ValueError, RuntimeError) as error:
        raise ConfigError(f"checkpoint {file}: {str(error)[:600]}") from error
    require_loaded(network, SavedTensors.open(file))
    network = network.eval().requires_grad_(False).to(device)
    return TorchFlow(network, device, settings, compilation)


def _dtype(settings: OpenPiConfig, *, on_cpu: bool) -> str:
    """Return the name of the type in which the model computes."""
    if settings.dtype != "auto":
        return settings.dtype
    return "float32" if on_cpu else "bfloat16"


def _observation(batch: dict[str, Any]) -> Any:
    """Return openpi's `Observation` of a batch of inputs."""
    data = {**batch, "image": dict(batch["image"])}  # a copy, since openpi writes into it
    return require("openpi.models.model").Observation.from_dict(data)


def _require_used(params: Any, network: Any, folder: Path, name: str) -> None:
    """Raise `ConfigError` if the model does not use LoRA tensors of a checkpoint.

    Other unused tensors, which base checkpoints contain, are logged.

    Args:
        params: The parameters of the checkpoint.
        network: The model that was made from them.
        folder: The folder of the checkpoint, for messages.
        name: The name of the training config, for messages.
    """
    flatten = require("flax.traverse_util").flatten_dict
    model_params = require("flax.nnx").state(network).to_pure_dict()
    model_names = set(flatten(model_params, sep="/"))
    unused = sorted(set(flatten(params, sep="/")) - model_names)
    if any("lora" in key for key in unused):
        raise ConfigError(
            f"checkpoint {folder}: was fine-tuned by LoRA, which config {name!r} does not have: "
            f"{unused[:_LISTED]}; choose the config that it was trained with, such as "
            "pi0_libero_low_mem_finetune"
        )
    if unused:
        logger.warning(
            "checkpoint %s: %d tensors have no place in the model: %s",
            folder,
            len(unused),
            unused[:_LISTED],
        )


_REMOTE = "://"


@dataclass(frozen=True)
class LoadedOpenPi:
    """A model with its transforms and the robot's convention."""

    model: OpenPiModel
    transforms: Transforms
    robot: RobotConvention
    horizon: int  # rows of a chunk


@dataclass(frozen=True)
class OpenPiFrame:
    """An observation in openpi's form, without the prompt, and the model's inputs that were made
    from it.
    """

    observation: dict[str, Any]  # result of `RobotConvention.read`
    inputs: dict[str, Any]  # result of `OpenPiModel.stage`


class OpenPi(ModelPolicy):
    """The policies of openpi, with one call of the model for many sessions."""

    Config: ClassVar[type] = OpenPiConfig
    config: OpenPiConfig
    model: LoadedOpenPi | None
    trainable = "model.model.trained"

    @property
    def contract(self) -> Contract:
        """The contract of the checkpoint and its robot.

        It is empty before the checkpoint is loaded.
        """
        if self.model is None:
            return Contract()

        robot = self.model.robot
        dims: dict[str, int] = {}
        for vector_parts in robot.state.values():
            dims.update(vector_parts)
        state = {
            name: StateSpec(dim) for name, dim in dims.items() if name not in (GRIPPER, CLOSED)
        }
        return self.make_contract(
            robot.cameras,
            list(dims),
            self.model.horizon,
            state=state,
            instruction=self.model.transforms.needs_prompt,
            action=robot.action,
            behaviour=self.offered(OFFERED if self.config.noise_level else ()),
        )

    @property
    def continues_plans(self) -> bool:
        """Whether a chunk continues the executed plan.

        Chunks of a flow do so with `actions: chunk`.
        """
        is_flow = self.model is not None and self.model.model.noise_shape is not None
        return is_flow and self.config.actions == "chunk"

    def load(self) -> LoadedOpenPi:
        """Read the checkpoint; raises `ConfigError` for settings that do not fit it."""
        use_source("openpi", SOURCE, self.config.source_dir, within=FOLDERS)
        config = train_config(self.config.config)
        folder = self._folder()
        transforms = Transforms.from_folder(config, folder)
        robot = choose_robot(config.name, transforms.robot, self.config)

        # A transform that the user wrote may need keys that the tested observation does not have.
        statistics = attempt(transforms.ranges, robot)
        if isinstance(statistics, Exception):
            logger.warning(
                "the statistics of the training are not available: %s: %s",
                type(statistics).__name__,
                statistics,
            )
            statistics = None
        self.statistics = statistics

        model = self._load_model(config, folder)
        return LoadedOpenPi(model, transforms, robot, config.model.action_horizon)

    def _load_model(self, config: Any, folder: Path) -> OpenPiModel:
        """Load the PyTorch model of a checkpoint; if there is none, load its JAX model."""
        if (folder / "model.safetensors").is_file():
            return load_torch(config, folder, self.config, self.compilation)
        if not (folder / "params").is_dir():
            raise ConfigError(
                f"checkpoint {folder}: expected params/ or model.safetensors, got "
                f"{sorted(path.name for path in folder.iterdir())}; name the folder of one step, "
                "not that of the run"
            )
        if self.config.compile not in (False, "auto"):
            raise ConfigError(
                "compile: expected none for a JAX checkpoint, whose programs XLA always compiles, "
                f"got {self.config.compile!r}; leave compile and attention out, or convert the "
                "checkpoint to PyTorch with openpi's script"
            )
        self.config = self.config.with_sizes(self.report.batch_sizes)
        return load_jax(config, folder, self.config)

    def merge_products(self) -> None:
        self.loaded().model.merge_products()

    def perceive(self, obs: Obs) -> OpenPiFrame:
        """Convert an observation to openpi's form and to the model's inputs."""
        loaded = self.loaded()
        observation = loaded.robot.read(obs)
        inputs = loaded.transforms.read(observation, self._current_episode().instruction)
        return OpenPiFrame(observation, loaded.model.stage(inputs))

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """Compute the chunks of all rows that openpi's transforms accept, in one call of the
        model.
        """
        planned = [attempt(self._planned, row) for row in rows]
        valid = [entry for entry in planned if not isinstance(entry, Exception)]
        if not valid:
            return planned  # contains only errors

        # A valid row replaces each invalid row, so that the size of the batch remains a compiled
        # size.
        spare_row, spare_noise = valid[0]
        spare_row = replace(spare_row, want=())
        batch_rows: list[Row] = []
        noise: list[np.ndarray] = []
        for entry in planned:
            is_invalid = isinstance(entry, Exception)
            row, row_noise = (spare_row, spare_noise) if is_invalid else entry
            batch_rows.append(row)
            noise.append(row_noise)

        loaded = self.loaded()
        if loaded.model.shares:
            firsts, owners = self.observations_of(batch_rows)
        else:
            firsts = owners = list(range(len(batch_rows)))
        inputs = [row.frames[-1].inputs for row in batch_rows]
        observations = [inputs[i] for i in firsts]
        stacked = loaded.model.stack(observations)
        outputs, behaviours = loaded.model.sample(
            SampleBatch(stacked, batch_rows, np.stack(noise), owners, loaded.robot.action.dim)
        )

        predictions: list[Prediction | Exception] = []
        for i, entry in enumerate(planned):
            if isinstance(entry, Exception):
                predictions.append(entry)
                continue
            actions = loaded.transforms.actions(inputs[i]["state"], outputs[i])
            predictions.append(Prediction(actions, behaviour=behaviours.get(i, {})))
        return predictions

    def _planned(self, row: Row) -> tuple[Row, np.ndarray]:
        """Return the row with its leftover plan in the model's units, and the row's noise."""
        loaded = self.loaded()
        if row.leftover is not None:
            observation = row.frames[-1].observation
            plan = loaded.transforms.plan(observation, row.instruction, row.leftover)
            row = replace(row, leftover=plan)
        return row, row.noise(*loaded.model.noise_shape or ())

    def _folder(self) -> Path:
        """Return the folder of the checkpoint. openpi downloads the checkpoint if it is a URL."""
        name, step = self.config.checkpoint, self.config.checkpoint_step
        if _REMOTE not in name:
            return find_checkpoint(name, step, needs=["assets"])
        url = name.replace(STEP, str(step))
        return find_checkpoint(str(require("openpi.shared.download").maybe_download(url)))


SOURCE = "OPENPI_SRC"  # variable with the path of a checkout; "openpi" on PyPI is another project
FOLDERS = ("src", "packages/openpi-client/src")  # folders of a checkout, from which Python imports


def train_config(name: str) -> Any:
    """Return openpi's `TrainConfig`.

    Args:
        name: The name of the config in openpi, or "module:NAME".

    Raises:
        ConfigError: The config does not exist.
    """
    configs = require("openpi.training.config")
    module, colon, attribute = name.partition(":")
    if not colon:
        try:
            return configs.get_config(name)
        except ValueError as error:
            raise ConfigError(
                f"config {name!r}: not one of openpi's {sorted(configs._CONFIGS_DICT)}"
            ) from error

    try:
        config = getattr(importlib.import_module(module), attribute, None)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"config {name!r}: no module {error.name!r}; add its folder to PYTHONPATH"
        ) from error
    if not isinstance(config, configs.TrainConfig):
        raise ConfigError(
            f"config {name!r}: expected an openpi TrainConfig, got {type(config).__name__}"
        )
    return config
