"""π0, π0-FAST and π0.5 with Physical Intelligence's own code, openpi, in JAX or PyTorch."""

from __future__ import annotations

import abc
import dataclasses
import importlib
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row
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
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import OFFERED, Guide
from vlagents_ray.policies.outcomes import attempt
from vlagents_ray.registry import require
from vlagents_ray_models.model_code import use_source
from vlagents_ray_models.pi0_passes import Pi0Passes

Layout = Literal["hwc", "chw"]


@dataclass(frozen=True, slots=True)
class RobotConvention:
    """The mapping of an `Obs` to the inputs of openpi's transforms for a robot."""

    cameras: Mapping[str, str]  # openpi's key -> our camera
    state: Mapping[str, Mapping[str, int]]  # openpi's key -> parts of our state and their lengths
    layout: Layout = "hwc"
    action: ActionSpec = field(default_factory=ActionSpec)
    optional: tuple[str, ...] = ()  # cameras that openpi masks if they are missing

    def read(self, obs: Obs) -> dict[str, Any]:
        """Convert an observation to openpi's, without the prompt: copies of the images, uint8,
        and states, float32.
        """
        data: dict[str, Any] = {}
        for key, image in camera_images(obs, self.cameras).items():
            _put(data, key, np.array(image if self.layout == "hwc" else image.transpose(2, 0, 1)))
        for key, parts in self.state.items():
            _put(data, key, state_vector(obs, list(parts), sum(parts.values())))
        return data


def _put(data: dict[str, Any], key: str, value: np.ndarray) -> None:
    *above, last = key.split(".")
    for name in above:
        data = data.setdefault(name, {})
    data[last] = value


_ALOHA = RobotConvention(
    {
        "images.cam_high": "front",
        "images.cam_left_wrist": "left_wrist",
        "images.cam_right_wrist": "right_wrist",
    },
    {"state": {"left/joints": 6, "left/gripper": 1, "right/joints": 6, "right/gripper": 1}},
    "chw",
    ActionSpec(dim=14, arms=("left", "right")),
    optional=("images.cam_left_wrist", "images.cam_right_wrist"),
)

# As in openpi's examples/{libero,droid,aloha_real,aloha_sim}. The gripper closes at 1 in actions of
# LIBERO and DROID (DROID's observed value is 0 when open); ALOHA's two, at 6 and 13, are in [0, 1],
# 1 = open, and stay unchanged.
ROBOTS: Mapping[str, RobotConvention] = {  # by the class of openpi's observation transform
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
_ENDS = ("q01", "q99")  # the statistics by which a robot is compared with the training


def choose_robot(config: str, transform: str, settings: OpenPiConfig) -> RobotConvention:
    """Return the convention of a config's robot, overridden by the settings; raises
    `ConfigError` if it is unknown.
    """
    cameras, state = settings.cameras, settings.state
    if (usual := ROBOTS.get(transform)) is None:
        if cameras is None or state is None:
            raise ConfigError(
                f"config {config!r}: its observations go through {transform or 'no transform'}, "
                f"want one of {sorted(ROBOTS)}, or its keys, as in cameras: {{KEY: front}}, state: "
                "{KEY: {joints: 7}}"
            )
        usual = RobotConvention(cameras, {})
    if cameras is None and config == "pi0_aloha_sim":
        cameras = {"images.cam_high": "front"}  # the simulation has one camera
    known = [
        key
        for key in usual.cameras
        if key not in usual.optional or cameras is None or key in cameras
    ]
    return replace(
        usual,
        cameras=choose_cameras(cameras, usual.cameras, known),
        state=usual.state if state is None else state,
        layout=settings.layout or usual.layout,
    )


@dataclass(frozen=True)
class Transforms:
    """The transforms of a checkpoint with its statistics, in the order of openpi's
    `create_trained_policy`.
    """

    inputs: Any  # a dict of unbatched arrays -> such a dict
    outputs: Any
    forward: Any  # the part of `inputs` for actions, before the model's own transforms
    # Of the training's states and actions, in the units of `forward`.
    bounds: Sequence[Mapping[str, np.ndarray]]
    robot: str  # the class of its first observation transform, e.g. "LiberoInputs"
    prompt: bool  # whether a prompt is needed; if not, the config has one

    @classmethod
    def of(cls, config: Any, folder: Path) -> Transforms:
        """Read the transforms; raises `ConfigError` if the checkpoint lacks statistics of the
        config's asset.
        """
        openpi = require("openpi.transforms")
        # with the checkpoint's statistics: openpi itself would first look online
        here = dataclasses.replace(config.data.assets, assets_dir=str(folder / "assets"))
        data = dataclasses.replace(config.data, assets=here).create(
            config.assets_dirs, config.model
        )
        statistics = _statistics(folder, data.asset_id)
        quantiles = data.use_quantile_norm
        try:
            normalise = openpi.Normalize(statistics, use_quantiles=quantiles)
            restore = openpi.Unnormalize(statistics, use_quantiles=quantiles)
        except ValueError as error:
            raise ConfigError(
                f"checkpoint {folder}: {error}; compute its statistics with openpi's script"
            ) from error
        robot, model = data.data_transforms, data.model_transforms
        known = all(getattr(one, end) is not None for one in statistics.values() for end in _ENDS)
        ends = [
            {name: getattr(one, end) for name, one in statistics.items()} for end in _ENDS if known
        ]
        return cls(
            openpi.compose([*robot.inputs, normalise, *model.inputs]),
            openpi.compose([*model.outputs, restore, *robot.outputs]),
            openpi.compose([*robot.inputs, normalise]),
            [normalise(one) for one in ends],
            type(robot.inputs[0]).__name__ if robot.inputs else "",
            not any(
                getattr(one, "prompt", None)
                for one in model.inputs
                if isinstance(one, openpi.InjectDefaultPrompt)
            ),
        )

    def read(self, observation: dict[str, Any], instruction: str) -> dict[str, Any]:
        inputs: dict[str, Any] = self.inputs(_with(observation, instruction))
        mask = np.asarray(inputs["tokenized_prompt_mask"])
        if mask.all():
            raise InvalidObservation(
                f"instruction: it fills all {mask.size} tokens of the model, so that its end may "
                "be cut off; shorten it"
            )
        return inputs

    def actions(self, state: np.ndarray, output: np.ndarray) -> np.ndarray:
        """Convert the model's output for one row to actions (H, D) float32, in the robot's
        units.
        """
        return np.asarray(self.outputs({"state": state, "actions": output})["actions"], np.float32)

    def plan(
        self, observation: dict[str, Any], instruction: str, actions: np.ndarray
    ) -> np.ndarray:
        """Convert a robot's actions (H, D) to the model's units, relative to the observation if
        the model's are.
        """
        data = _with(observation, instruction) | {"actions": np.array(actions)}
        return np.asarray(self.forward(data)["actions"], np.float32)

    def ranges(self, robot: RobotConvention) -> dict[str, Any] | None:
        """Return `Agent.statistics` in the robot's units, with None for numbers that `forward` does
        not only scale.

        openpi's statistics are of transformed numbers: some of ALOHA's joints have another sign,
        most actions are relative to the state. Random numbers show which ones are the robot's own,
        by a factor and an offset.
        """
        widths, rng = (
            [sum(parts.values()) for parts in robot.state.values()],
            np.random.default_rng(0),
        )
        image, seen = (
            np.zeros((224, 224, 3) if robot.layout == "hwc" else (3, 224, 224), np.uint8),
            [],
        )
        dims = {"state": sum(widths), "actions": robot.action.dim}
        if not self.bounds or dims["actions"] is None:
            return None
        given = [
            {name: scale * rng.uniform(0.2, 0.8, dim) for name, dim in dims.items()}
            for scale in (0, 1, 1)
        ]
        for one in given:
            # A copy, which transforms change.
            data: dict[str, Any] = {"actions": np.array(one["actions"], ndmin=2)}
            state = dict(
                zip(robot.state, np.split(one["state"], np.cumsum(widths)[:-1]), strict=True)
            )
            for key, value in (dict.fromkeys(robot.cameras, image) | state).items():
                _put(data, key, value)
            seen.append(self.forward(data))
        found: dict[str, Any] = {
            "parts": [part for parts in robot.state.values() for part in parts]
        }
        for (name, dim), key in zip(dims.items(), ("observation.state", "action"), strict=True):
            zero, first, second = (np.ravel(one[name])[:dim] for one in seen)
            factor = (first - zero) / given[1][name]
            factor[
                ~np.isclose(second, zero + factor * given[2][name], atol=1e-4) | (factor == 0)
            ] = np.nan
            ends = np.sort(
                [(bound[name][:dim] - zero) / factor for bound in self.bounds], axis=0
            ).tolist()
            found[key] = {
                _ENDS[i]: [None if np.isnan(x) else x for x in row] for i, row in enumerate(ends)
            }
        return found


def _with(observation: dict[str, Any], instruction: str) -> dict[str, Any]:
    """Copy an observation as deeply as openpi's transforms modify it."""
    data: dict[str, Any] = require("jax").tree.map(np.array, observation)
    return data | {"prompt": instruction} if instruction else data


def _statistics(folder: Path, asset: str | None) -> Any:
    if asset is None:
        raise ConfigError(
            "config: has no asset_id, so that nothing says which statistics are its own; set one"
        )
    try:
        found = require("openpi.shared.normalize").load(folder / "assets" / asset)
    except FileNotFoundError as error:
        have = sorted(
            str(p.parent.relative_to(folder / "assets"))
            for p in folder.glob("assets/**/norm_stats.json")
        )
        raise ConfigError(
            f"checkpoint {folder}: no assets/{asset}/norm_stats.json, has those of {have}; without "
            "statistics a policy's actions have no units: copy them there, or choose the config of "
            "its training"
        ) from error
    if absent := sorted({"state", "actions"} - set(found)):
        raise ConfigError(
            f"checkpoint {folder}: assets/{asset}/norm_stats.json has no {absent}, has "
            f"{sorted(found)}"
        )
    return found


class OpenPiConfig(ModelConfig):
    """Settings of openpi's policies, in addition to those of all models."""

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
        description="a checkout of openpi; unset: the variable OPENPI_SRC, or what is installed",
    )
    cameras: dict[str, str] | None = Field(
        default=None,
        description="openpi's keys of the images -> our cameras, a dot going one level down: "
        "images.cam_high; unset: "
        "those of the config's robot",
    )
    state: dict[str, dict[str, int]] | None = Field(  # type: ignore[assignment]  # openpi has several vectors, by key
        default=None,
        description="openpi's keys of the state -> the parts of ours that make up each, and how "
        "many numbers each has; "
        "'gripper' stands for `Obs.gripper`, 'gripper_closed' for 1 minus that; unset: those of "
        "the config's robot",
    )
    layout: Layout | None = Field(
        default=None, description="layout of the images for the transforms: hwc or chw"
    )
    steps: int | None = Field(
        default=None, ge=1, description="steps of the flow (pi0, pi0.5); unset: openpi's, 10"
    )
    max_decoding_steps: int = Field(
        default=256, ge=1, description="largest number of tokens of a chunk (pi0-FAST)"
    )
    guidance: Guidance = 5.0
    noise_level: NoiseLevel = 0.0


logger = logging.getLogger(__name__)

_STEPS = 10  # openpi's own default
_END = 1  # PaliGemma's end of sequence
_LISTED = 5


@dataclass(frozen=True, slots=True)
class SampleBatch:
    """The inputs of a model for B chunks."""

    inputs: dict[str, Any]  # of P observations
    rows: Sequence[Row]  # with plans in the model's units
    noise: np.ndarray  # one array for each row
    owners: Sequence[int]  # the observation of each row, as of `ModelPolicy.observations_of`
    dim: int | None  # how many numbers of an action are the robot's


class OpenPiModel(abc.ABC):
    """The interface between a model and the policy."""

    # (H, action_dim) of a row's noise; None for a model without noise.
    noise_shape: tuple[int, int] | None = None
    shares = False  # whether several rows can share one observation
    # What a learner trains: the torch module, or the dicts of arrays that JAX checkpoints have.
    trained: Any

    @abc.abstractmethod
    def sample(self, batch: SampleBatch) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
        """Compute actions (B, H, action_dim), or tokens (B, T), and the outputs requested of
        rows, by their places.
        """


class JaxFlow(OpenPiModel):
    """π0 and π0.5 in JAX, as two programs, each compiled once per number of rows.

    The first computes the keys and values of images and instruction, once for each observation.
    From these the second follows the flow of each row, with the steps of openpi's `sample_actions`.
    """

    shares = True

    def __init__(self, network: Any, device: Any, config: OpenPiConfig) -> None:
        jax, models = require("jax"), require("openpi.models.model")
        jnp, attention_mask = jax.numpy, require("openpi.models.pi0").make_attn_mask
        self.trained, merged = _split(network)
        self._device = device
        steps, limit = config.steps or _STEPS, config.guidance

        def encode(params: Any, batch: Any) -> Any:
            model = merged(params)
            observation = models.preprocess_observation(None, _observation(batch), train=False)
            tokens, seen, causal = model.embed_prefix(observation)
            mask, places = attention_mask(seen, causal), jnp.cumsum(seen, axis=1) - 1
            _, (keys, values) = model.PaliGemma.llm([tokens, None], mask=mask, positions=places)
            # Rows before layers.
            return keys.swapaxes(0, 1), values.swapaxes(0, 1), seen, observation.state

        def follow(params: Any, encoded: Any, noise: Any, guide: Any) -> Any:
            model, guide = merged(params), Guide(*guide)
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
                velocity = guide.steer(
                    velocity,
                    actions,
                    time,
                    noise=noise,
                    steps=steps,
                    limit=limit,
                    lower=jnp.minimum,
                )
                return actions - velocity / steps, time - 1 / steps

            return jax.lax.while_loop(lambda now: now[1] >= 0.5 / steps, step, (noise, 1.0))[0]

        def gather(encoded: Any, owners: Any) -> Any:
            return jax.tree.map(lambda one: one[owners], encoded)

        # `gather` is apart from `follow`: one of each two sizes compiles in no time, `follow` in
        # minutes
        self._encode, self._gather, self._follow = jax.jit(encode), jax.jit(gather), jax.jit(follow)
        self.noise_shape = (network.action_horizon, network.action_dim)

    def sample(self, batch: SampleBatch) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
        """Compute actions (B, H, action_dim) float32; a batch without plans runs the same
        program without guidance.
        """
        jax, guide = require("jax"), Guide.for_rows(batch.rows, *batch.noise.shape[1:])
        if guide is None:
            none = np.zeros((*batch.noise.shape[:2], 1), np.float32)
            guide = Guide(np.zeros_like(batch.noise), none, none)
        given = (
            batch.inputs,
            np.asarray(batch.owners),
            batch.noise,
            (guide.plan, guide.frozen, guide.weight),
        )
        inputs, owners, noise, plan = jax.device_put(given, self._device)
        encoded = self._encode(self.trained, inputs)
        if len(encoded[0]) < len(owners):
            encoded = self._gather(encoded, owners)
        # Waits for the device.
        return np.asarray(self._follow(self.trained, encoded, noise, plan), np.float32), {}


class JaxTokens(OpenPiModel):
    """π0-FAST in JAX, with greedy decoding and without noise."""

    def __init__(self, network: Any, device: Any, config: OpenPiConfig) -> None:
        jax, self._device, most = require("jax"), device, config.max_decoding_steps
        self.trained, merged = _split(network)

        def sample(params: Any, batch: Any) -> Any:
            return merged(params).sample_actions(
                jax.random.key(0), _observation(batch), max_decoding_steps=most
            )

        self._sample = jax.jit(sample)

    def sample(self, batch: SampleBatch) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
        tokens = self._sample(self.trained, require("jax").device_put(batch.inputs, self._device))
        return self.ended(np.asarray(tokens, np.int32)), {}

    @staticmethod
    def ended(tokens: np.ndarray) -> np.ndarray:
        """Set the tokens (B, T) after each row's end to zero: openpi decodes until all rows have
        ended.
        """
        ends = tokens == _END
        return np.where(np.cumsum(ends, axis=1) - ends > 0, 0, tokens)


class TorchFlow(OpenPiModel):
    """openpi's PyTorch port of π0 and π0.5."""

    shares = True

    def __init__(
        self, network: Any, device: Any, config: OpenPiConfig, compilation: Compilation
    ) -> None:
        self.trained, self._device = network, device
        self._passes = Pi0Passes(network, compilation)
        self._config, self.noise_shape = (
            config,
            (network.config.action_horizon, network.config.action_dim),
        )

    def sample(self, batch: SampleBatch) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
        observation = _observation(require("jax").tree.map(self._convert, batch.inputs))
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

    def _convert(self, array: np.ndarray) -> Any:
        """Return a copy of the array as a tensor on the device."""
        return require("torch").from_numpy(np.array(array)).to(self._device, non_blocking=True)


def _split(network: Any) -> tuple[dict[str, Any], Callable[[Any], Any]]:
    """Return the parameters of a JAX model by openpi's names, and the function that makes the
    model of them.
    """
    jax, nnx = require("jax"), require("flax.nnx")
    graph, state = nnx.split(network)
    # Of the same leaves as the dicts, as both are sorted by their keys.
    structure = jax.tree.structure(state)
    return state.to_pure_dict(), lambda params: nnx.merge(
        graph, jax.tree.unflatten(structure, jax.tree.leaves(params))
    )


def load_jax(config: Any, folder: Path, settings: OpenPiConfig) -> OpenPiModel:
    """Load a JAX model; raises `ConfigError` if a parameter of the model or of its fine-tuning
    is missing.
    """
    jax, models = require("jax"), require("openpi.models.model")
    device = jax_device({"cuda": "gpu"}.get(settings.device, settings.device))
    dtype = (
        ("float32" if device.platform == "cpu" else "bfloat16")
        if settings.dtype == "auto"
        else settings.dtype
    )
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
            f"noise_level: got {settings.noise_level} for a JAX checkpoint, want 0, as its "
            "compiled loop has no random steps; convert it to PyTorch with openpi's script, or "
            "leave it out"
        )
    kind = JaxTokens if config.model.model_type is models.ModelType.PI0_FAST else JaxFlow
    return kind(network, device, settings)


def load_torch(
    config: Any, folder: Path, settings: OpenPiConfig, compilation: Compilation
) -> OpenPiModel:
    """Load a PyTorch model; raises `ConfigError` if transformers lacks openpi's patch, or a
    parameter is missing.
    """
    device = torch_device(settings.device)
    file = folder / "model.safetensors"
    chosen = (
        settings.dtype
        if settings.dtype != "auto"
        else ("float32" if device.type == "cpu" else "bfloat16")
    )
    model = dataclasses.replace(config.model, pytorch_compile_mode=None, dtype=chosen)
    config = dataclasses.replace(config, model=model)
    try:
        network = config.model.load_pytorch(config, str(file))
    except (ValueError, RuntimeError) as error:
        raise ConfigError(f"checkpoint {file}: {str(error)[:600]}") from error
    network.paligemma_with_expert.to_bfloat16_for_selected_params(chosen)
    require_loaded(network, SavedTensors.open(file))
    return TorchFlow(network.eval().requires_grad_(False).to(device), device, settings, compilation)


def _observation(batch: dict[str, Any]) -> Any:
    data = {**batch, "image": dict(batch["image"])}  # openpi writes into it
    return require("openpi.models.model").Observation.from_dict(data)


def _require_used(params: Any, network: Any, folder: Path, name: str) -> None:
    """Raise `ConfigError` if the model drops LoRA tensors; other unused tensors, as in base
    checkpoints, are logged.
    """
    flatten = require("flax.traverse_util").flatten_dict
    own = set(flatten(require("flax.nnx").state(network).to_pure_dict(), sep="/"))
    extra = sorted(set(flatten(params, sep="/")) - own)
    if any("lora" in key for key in extra):
        raise ConfigError(
            f"checkpoint {folder}: was fine-tuned by LoRA, which config {name!r} does not have: "
            f"{extra[:_LISTED]}; choose the config that it was trained with, such as "
            "pi0_libero_low_mem_finetune"
        )
    if extra:
        logger.warning(
            "checkpoint %s: %d tensors have no place in the model: %s",
            folder,
            len(extra),
            extra[:_LISTED],
        )


_REMOTE = "://"


@dataclass(frozen=True)
class LoadedOpenPi:
    """A model with its transforms and the robot's convention."""

    model: OpenPiModel
    transforms: Transforms
    robot: RobotConvention
    horizon: int


@dataclass(frozen=True)
class SeenObs:
    """An observation in openpi's form, without the prompt, and the model's inputs made from it."""

    raw: dict[str, Any]
    inputs: dict[str, Any]


class OpenPi(ModelPolicy):
    """The policies of openpi, with one call of the model for many sessions."""

    Config: ClassVar[type] = OpenPiConfig
    config: OpenPiConfig
    model: LoadedOpenPi | None
    trainable = "model.model.trained"

    @property
    def contract(self) -> Contract:
        if self.model is None:
            return Contract()
        robot = self.model.robot
        parts = {part: dim for vector in robot.state.values() for part, dim in vector.items()}
        return self.stated(
            robot.cameras,
            list(parts),
            self.model.horizon,
            state={
                part: StateSpec(dim) for part, dim in parts.items() if part not in (GRIPPER, CLOSED)
            },
            instruction=self.model.transforms.prompt,
            action=robot.action,
            behaviour=self.offered(OFFERED if self.config.noise_level else ()),
        )

    @property
    def continues_plans(self) -> bool:
        flows = self.model is not None and self.model.model.noise_shape is not None
        return flows and self.config.actions == "chunk"

    def load(self) -> LoadedOpenPi:
        use_source("openpi", SOURCE, self.config.source_dir, within=FOLDERS)
        config = train_config(self.config.config)
        folder = self._folder()
        transforms = Transforms.of(config, folder)
        robot = choose_robot(config.name, transforms.robot, self.config)
        # A transform of the user's own may want more of an observation.
        found = attempt(transforms.ranges, robot)
        if isinstance(found, Exception):
            logger.warning(
                "the statistics of the training are not stated: %s: %s", type(found).__name__, found
            )
            found = None
        self.statistics = found
        if (folder / "model.safetensors").is_file():
            model = load_torch(config, folder, self.config, self.compilation)
        elif (folder / "params").is_dir():
            if self.config.compile not in (False, "auto"):
                raise ConfigError("compile: openpi's JAX models always are; leave it out")
            self.config = self.config.with_sizes(self.report.batch_sizes)
            model = load_jax(config, folder, self.config)
        else:
            raise ConfigError(
                f"checkpoint {folder}: has {sorted(p.name for p in folder.iterdir())}, want "
                "params/ or model.safetensors; name the folder of one step, not that of the run"
            )
        return LoadedOpenPi(model, transforms, robot, config.model.action_horizon)

    def perceive(self, obs: Obs) -> SeenObs:
        loaded = self.loaded()
        seen = loaded.robot.read(obs)
        return SeenObs(seen, loaded.transforms.read(seen, self._begun().instruction))

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """Compute the chunks of all rows that openpi's transforms accept, in one call of the
        model.
        """
        read = [attempt(self._planned, row) for row in rows]
        if (spare := next((one for one in read if not isinstance(one, Exception)), None)) is None:
            return read  # errors all
        # A valid row replaces an invalid one, so that the number of rows stays one that is
        # compiled.
        spare = replace(spare[0], want=()), spare[1]
        ready, noise = zip(
            *(spare if isinstance(one, Exception) else one for one in read), strict=True
        )
        loaded, each = self.loaded(), list(range(len(ready)))
        firsts, owners = self.observations_of(ready) if loaded.model.shares else (each, each)
        inputs = [row.frames[-1].inputs for row in ready]
        batch = require("jax").tree.map(
            lambda *leaves: np.stack(leaves), *(inputs[i] for i in firsts)
        )
        flows, stated = loaded.model.sample(
            SampleBatch(batch, ready, np.stack(noise), owners, loaded.robot.action.dim)
        )
        return [
            one
            if isinstance(one, Exception)
            else Prediction(
                loaded.transforms.actions(own["state"], flow), behaviour=stated.get(i, {})
            )
            for i, (one, own, flow) in enumerate(zip(read, inputs, flows, strict=True))
        ]

    def _planned(self, row: Row) -> tuple[Row, np.ndarray]:
        """Return the row with its leftover actions in the model's units, and its noise."""
        loaded = self.loaded()
        if row.leftover is not None:
            plan = loaded.transforms.plan(row.frames[-1].raw, row.instruction, row.leftover)
            row = replace(row, leftover=plan)
        return row, row.noise(*loaded.model.noise_shape or ())

    def _folder(self) -> Path:
        name, step = self.config.checkpoint, self.config.checkpoint_step
        if _REMOTE not in name:
            return find_checkpoint(name, step, needs=["assets"])
        return find_checkpoint(
            str(require("openpi.shared.download").maybe_download(name.replace(STEP, str(step))))
        )


SOURCE = "OPENPI_SRC"  # the variable that names a checkout; "openpi" on PyPI is another project
FOLDERS = ("src", "packages/openpi-client/src")


def train_config(name: str) -> Any:
    """Return openpi's `TrainConfig` named `name`, or the one at "module:NAME"."""
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
        found = getattr(importlib.import_module(module), attribute, None)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"config {name!r}: no module {error.name!r}; add its folder to PYTHONPATH"
        ) from error
    if not isinstance(found, configs.TrainConfig):
        raise ConfigError(
            f"config {name!r}: got {type(found).__name__}, want an openpi TrainConfig"
        )
    return found
