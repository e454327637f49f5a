"""V-JEPA 2-AC (arXiv 2506.09985), which plans towards a goal image in a learned world model with
the cross-entropy method.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidObservation, MissingDependency
from vlagents_ray.interface import GOAL_IMAGE, Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.accelerator import (
    ensure_torchvision,
    fetch,
    torch_device,
    torch_dtype,
)
from vlagents_ray.policies.base.checkpoint import find_checkpoint, from_pretrained, require_loaded
from vlagents_ray.policies.base.config import ModelConfig
from vlagents_ray.policies.base.model_inputs import (
    GRIPPER,
    camera_images,
    choose_cameras,
    state_specs,
    state_vector,
)
from vlagents_ray.policies.base.staging import StagedRow, Staging
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.outcomes import compute_valid
from vlagents_ray.registry import require
from vlagents_ray_models.model_code import use_source


class VJepa2AcConfig(ModelConfig):
    """Settings of V-JEPA 2-AC for its checkpoint and the search for plans, in addition to the
    settings of all models.
    """

    encoder: str | None = Field(
        default=None,
        description="folder or hub id (org/name@COMMIT) of a `VJEPA2Model` instead of the encoder "
        "in the checkpoint",
    )
    source_dir: str | None = Field(
        default=None,
        description="checkout of vjepa2, for the predictor's code; unset: the checkout that "
        "VJEPA2_SRC names, or the installed package",
    )
    encoder_heads: int | None = Field(
        default=None,
        ge=1,
        description="attention heads of the checkpoint's encoder; unset: those of ViT-L, -H or -g",
    )
    predictor_heads: int = Field(default=16, ge=1, description="attention heads of the predictor")
    image_size: int = Field(
        default=256, ge=16, description="pixels of a side, as the model was trained"
    )

    execute: int | None = Field(
        default=1, ge=1, description="steps of a plan that are executed; in the paper one"
    )
    rollout: int = Field(default=2, ge=1, description="steps of a plan")
    samples: int = Field(default=400, ge=2, description="plans sampled in an iteration")
    topk: int = Field(
        default=10, ge=2, description="number of best plans that determine the next distribution"
    )
    iterations: int = Field(default=10, ge=1, description="iterations of the search for a plan")
    maxnorm: float = Field(default=0.05, gt=0, description="largest step along each axis, m")
    pass_size: int = Field(
        default=400, ge=1, description="largest number of plans in a forward pass of the predictor"
    )

    @property
    def plans_a_pass(self) -> int:
        """The largest number of plans in a forward pass of the predictor.

        With compilation, full passes have this number of plans.
        """
        return min(self.samples, self.pass_size) if self.compile else self.pass_size

    @model_validator(mode="after")
    def _topk_within_samples(self) -> Self:
        if self.topk > self.samples:
            raise ValueError(
                f"topk: expected a small part of the {self.samples} samples, got {self.topk}; "
                "lower it"
            )
        return self


# Mean and standard deviation of ImageNet's colours, in [0, 1].
_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)
# Width of an encoder -> number of its attention heads, for ViT-L, ViT-H and ViT-g.
_HEADS = {1024: 16, 1280: 16, 1408: 22}

# The name in transformers -> tensor of an encoder.
_PATCHES = "encoder.embeddings.patch_embeddings.proj.weight"
_FIRST_MLP = "encoder.layer.0.mlp.fc1.weight"


def to_pixels(image: np.ndarray, side: int) -> np.ndarray:
    """Crop, resize and normalise an image as upstream does.

    Args:
        image: (H, W, 3) uint8.
        side: The side of the result, px.

    Returns:
        (3, side, side) float32.
    """
    torch = require("torch")
    height, width = image.shape[:2]
    edge = min(height, width)
    top, left = (height - edge) // 2, (width - edge) // 2
    square = torch.tensor(image[top : top + edge, left : left + edge], dtype=torch.float32)
    [resized] = torch.nn.functional.interpolate(
        square.permute(2, 0, 1)[None], size=(side, side), mode="bilinear", align_corners=False
    )

    mean, std = (torch.tensor(values)[:, None, None] * 255 for values in (_MEAN, _STD))
    return np.asarray(((resized - mean) / std).numpy())


def load_encoder(config: VJepa2AcConfig, saved: Mapping[str, Any] | None) -> Any:
    """Load the encoder.

    Args:
        config: The settings of the policy, whose `encoder` may name a saved `VJEPA2Model`.
        saved: Upstream's weights, which are used if `config.encoder` is unset; None if the
            checkpoint has none.

    Returns:
        A `VJEPA2Model` of transformers.

    Raises:
        ConfigError: There is no encoder, or it lacks weights, or it needs images of another size.
    """
    ensure_torchvision()
    transformers = require("transformers")
    if config.encoder is not None:
        path = find_checkpoint(config.encoder, needs=("config.json", "*.safetensors"))
        model = from_pretrained(transformers.VJEPA2Model, path)
        if model.config.crop_size != config.image_size:
            raise ConfigError(
                f"encoder {path}: expected images of {config.image_size} px, as in image_size, "
                f"got {model.config.crop_size}; give that of the checkpoint's predictor"
            )
        return model
    if saved is None:
        raise ConfigError(
            f"checkpoint {config.checkpoint!r}: it has no 'encoder'; name a folder with a "
            "VJEPA2Model as the policy's `encoder`, or a checkpoint with both, such as "
            "vjepa2-ac-vitg.pt"
        )
    return from_upstream(saved, config)


def from_upstream(saved: Mapping[str, Any], config: VJepa2AcConfig) -> Any:
    """Make a `VJEPA2Model` with upstream's weights.

    Args:
        saved: Upstream's tensors by name.
        config: The settings of the policy.

    Raises:
        ConfigError: Weights are missing, or the number of attention heads is unknown.
    """
    transformers = require("transformers")
    tensors = _renamed(saved)
    width, _, tubelet, patch, _ = tensors[_PATCHES].shape
    heads = config.encoder_heads or _HEADS.get(width)
    if heads is None:
        raise ConfigError(
            f"encoder_heads: unset, and {width} is the width of none of {sorted(_HEADS)}; set it"
        )

    layers = {name.split(".")[2] for name in tensors if name.startswith("encoder.layer.")}
    settings = transformers.VJEPA2Config(
        patch_size=patch,
        crop_size=config.image_size,
        tubelet_size=tubelet,
        hidden_size=width,
        num_attention_heads=heads,
        num_hidden_layers=len(layers),
        mlp_ratio=tensors[_FIRST_MLP].shape[0] / width,
        pred_num_hidden_layers=1,  # V-JEPA 2's predictor of masked patches is not used.
    )
    model = transformers.VJEPA2Model(settings)
    model.predictor = require("torch").nn.Identity()
    missing, _ = model.load_state_dict(tensors, strict=False)
    if missing:
        raise ConfigError(
            "the checkpoint's encoder: expected upstream's parameters, got none of "
            f"{missing[:8]}; check whether it is upstream's, and whole"
        )
    require_loaded(model, tensors)
    return model


def _renamed(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return upstream's tensors under transformers' names.

    Upstream stores query, key and value in one matrix, while transformers uses three matrices.
    """
    tensors: dict[str, Any] = {}
    for upstream_name, tensor in saved.items():
        name = f"encoder.{upstream_name}"
        name = name.replace("encoder.patch_embed.", "encoder.embeddings.patch_embeddings.")
        name = name.replace("encoder.norm.", "encoder.layernorm.")
        name = name.replace("encoder.blocks.", "encoder.layer.")
        name = name.replace(".attn.", ".attention.")
        if ".qkv." not in name:
            tensors[name] = tensor
            continue
        for projection, matrix in zip(("query", "key", "value"), tensor.chunk(3), strict=True):
            tensors[name.replace("qkv", projection)] = matrix

    if _PATCHES not in tensors or _FIRST_MLP not in tensors:
        raise ConfigError(
            "the checkpoint's encoder: expected upstream's names, as 'patch_embed.proj.weight', "
            f"got {sorted(saved)[:4]}"
        )
    return tensors


# The prefixes of names that distributed training and upstream's wrapper add.
_PREFIXES = re.compile(r"module\.|backbone\.")


def read_checkpoint(config: VJepa2AcConfig) -> dict[str, dict[str, Any]]:
    """Read upstream's file. Only tensors are unpickled.

    Args:
        config: The settings of the policy, which name the checkpoint.

    Returns:
        The tensors by name of each network in the file: "predictor", and "encoder" if there is one.

    Raises:
        ConfigError: There is no file, or there are several files, or the file has no predictor.
    """
    torch = require("torch")
    path = find_checkpoint(config.checkpoint, config.checkpoint_step, needs=("*.pt",))
    files = [path] if path.is_file() else sorted(path.glob("*.pt"))
    if len(files) != 1:
        raise ConfigError(
            f"checkpoint {path}: expected one .pt file, got {[file.name for file in files]}; name "
            "it"
        )

    [file] = files
    try:
        content = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # The file may not be a zip file, or may be a pickle of other types.
        raise ConfigError(
            f"checkpoint {file}: expected upstream's .pt, a file of tensors, got another "
            f"({type(error).__name__})"
        ) from error
    if not isinstance(content, Mapping) or not isinstance(content.get("predictor"), Mapping):
        description: object = type(content).__name__
        if isinstance(content, Mapping):
            description = sorted(map(str, content))[:8]
        raise ConfigError(
            f"checkpoint {file}: expected 'predictor', got {description}; check whether it is "
            "V-JEPA 2-AC's, and not V-JEPA 2's"
        )

    networks: dict[str, dict[str, Any]] = {}
    for network, tensors in content.items():
        if isinstance(tensors, Mapping):
            networks[network] = {
                _PREFIXES.sub("", str(name)): tensor for name, tensor in tensors.items()
            }
    return networks


def load_predictor(config: VJepa2AcConfig, saved: Mapping[str, Any], width: int) -> Any:
    """Load the predictor.

    Args:
        config: The settings of the policy.
        saved: The predictor's tensors by name.
        width: The width of the encoder's features.

    Returns:
        The network, an instance of upstream's own class.

    Raises:
        MissingDependency: The predictor's code is missing.
        ConfigError: A weight is missing, or the predictor does not fit the encoder.
    """
    use_source("src", "VJEPA2_SRC", config.source_dir)
    try:
        module = importlib.import_module("src.models.ac_predictor")
    except ModuleNotFoundError as error:
        raise MissingDependency(
            f"the predictor's code cannot be imported: no module {error.name!r}; is `src` "
            "vjepa2's, and timm installed?"
        ) from error

    embedding = saved.get("predictor_embed.weight")
    if embedding is None or embedding.shape[1] != width:
        description = "no 'predictor_embed.weight'"
        if embedding is not None:
            description = f"{embedding.shape[1]} wide"
        raise ConfigError(
            f"checkpoint {config.checkpoint!r}: expected a predictor of features {width} wide, as "
            f"the encoder's are, got {description}; use those of one checkpoint"
        )

    blocks = {name.split(".")[1] for name in saved if name.startswith("predictor_blocks.")}
    model = module.vit_ac_predictor(
        img_size=(config.image_size, config.image_size),
        # Tubelets have two frames. This value determines only the size of the mask.
        num_frames=2 * config.rollout,
        tubelet_size=2,
        embed_dim=width,
        predictor_embed_dim=embedding.shape[0],
        depth=len(blocks),
        num_heads=config.predictor_heads,
    )
    try:
        model.load_state_dict(saved)
    except RuntimeError as error:
        raise ConfigError(
            f"checkpoint {config.checkpoint!r}: its predictor does not fit: {str(error)[:500]}"
        ) from error
    require_loaded(model, saved)
    return model


@contextmanager
def default_attention() -> Iterator[None]:
    """Make upstream's attention use the kernel that torch selects.

    Upstream's own selection of a kernel cannot be compiled.
    """
    backend = require("torch").backends.cuda
    setter, backend.sdp_kernel = backend.sdp_kernel, nullcontext
    try:
        yield
    finally:
        backend.sdp_kernel = setter


Tensor = Any  # a tensor of torch
World = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Predicts the next frame's features (M, N, F) from features (M, T, N, F), actions (M, T, 7) and
poses (M, T, 7).
"""

DRAWN = 4  # number of sampled components of an action: x, y, z and the gripper
_MAX_GRIPPER_CHANGE = 0.75  # largest change of the gripper in a step
_MIN_GRIPPER_CHANGE = 0.25  # smaller changes become zero
# Share of the last iteration's mean and deviation, of positions and of the gripper, as upstream.
_MOMENTUM = 0.15


@dataclass(frozen=True, slots=True)
class Plans:
    """The plans of all sessions."""

    actions: Tensor  # (B, H, 7)
    std: Tensor  # standard deviation of the last distribution, (B, H, 7)
    energy: Tensor  # distance of the last iteration's best plan from the goal, (B,)


def plan(
    world: World,
    features: Tensor,
    poses: Tensor,
    goals: Tensor,
    noise: Tensor,
    config: VJepa2AcConfig,
) -> Plans:
    """Search for plans with the cross-entropy method, in I iterations with S samples of H actions
    each.

    Args:
        world: The predictor.
        features: The features of the current images, (B, N, F).
        poses: The current poses, (B, 7).
        goals: The features of the goal images, (B, N, F).
        noise: (B, I, H, S, 4), standard normal.
        config: The settings of the search.

    Returns:
        The plan of each of the B sessions.
    """
    torch = require("torch")
    mean = torch.zeros(len(poses), config.rollout, DRAWN, device=poses.device)
    std = torch.ones_like(mean)
    std[..., :3] = config.maxnorm

    energy = torch.zeros(len(poses), 0)
    for draws in noise.unbind(1):
        samples = _bounded(draws * std[:, :, None] + mean[:, :, None], config)  # (B, H, S, 4)
        actions = _actions(samples.transpose(1, 2))
        energy = _energies(world, features, poses, goals, actions, config.plans_a_pass)
        best = energy.topk(config.topk, largest=False).indices  # (B, K)
        chosen = samples.gather(2, best[:, None, :, None].expand(-1, config.rollout, -1, DRAWN))
        mean = chosen.mean(2) * (1 - _MOMENTUM) + mean * _MOMENTUM
        std = chosen.std(2) * (1 - _MOMENTUM) + std * _MOMENTUM

    gripper = mean[..., 3:]
    gripper = torch.where(gripper.abs() < _MIN_GRIPPER_CHANGE, 0.0, gripper)
    planned = torch.cat([mean[..., :3], gripper], -1)
    return Plans(_actions(planned), _actions(std), energy.min(1).values)


def _bounded(samples: Tensor, config: VJepa2AcConfig) -> Tensor:
    """Limit sampled actions, (B, H, S, 4), to the largest change in one step."""
    torch = require("torch")
    position = samples[..., :3].clip(-config.maxnorm, config.maxnorm)
    gripper = samples[..., 3:].clip(-_MAX_GRIPPER_CHANGE, _MAX_GRIPPER_CHANGE)
    return torch.cat([position, gripper], -1)


def _actions(samples: Tensor) -> Tensor:
    """Expand sampled actions (..., 4) to (..., 7), without rotation."""
    torch = require("torch")
    position, gripper = samples[..., :3], samples[..., 3:]
    return torch.cat([position, torch.zeros_like(position), gripper], -1)


def _energies(
    world: World, features: Tensor, poses: Tensor, goals: Tensor, actions: Tensor, pass_size: int
) -> Tensor:
    """Compute the distances between the ends of plans and their goals.

    Args:
        world: The predictor.
        features: The features of the current images, (B, N, F).
        poses: The current poses, (B, 7).
        goals: The features of the goal images, (B, N, F).
        actions: The actions of S plans of each session, (B, S, H, 7).
        pass_size: The largest number of plans in a forward pass.

    Returns:
        The mean absolute difference between the goal and the predicted features, (B, S).
    """
    torch = require("torch")
    sessions, samples, horizon = actions.shape[:3]
    owners = torch.arange(sessions, device=poses.device).repeat_interleave(samples)
    all_plans = actions.flatten(0, 1)

    energies = []
    for plans, owner in zip(all_plans.split(pass_size), owners.split(pass_size), strict=True):
        frames, path = features[owner][:, None], poses[owner][:, None]
        for step in range(horizon):
            next_frame = world(frames, plans[:, : step + 1], path)
            frames = torch.cat([frames, next_frame[:, None]], 1)
            path = torch.cat([path, moved(path[:, -1], plans[:, step])[:, None]], 1)
        energies.append((frames[:, -1] - goals[owner]).abs().flatten(1).mean(1))
    return torch.cat(energies).view(sessions, samples)


def moved(poses: Tensor, actions: Tensor) -> Tensor:
    """Return the poses that result from actions.

    Args:
        poses: The poses before the actions, (M, 7): x, y, z in m; Euler angles in rad; closedness
            of the gripper in [0, 1].
        actions: Changes of these values, (M, 7), without rotation.

    Returns:
        The poses, (M, 7).
    """
    torch = require("torch")
    closedness = (poses[:, 6:] + actions[:, 6:]).clip(0, 1)
    return torch.cat([poses[:, :3] + actions[:, :3], poses[:, 3:6], closedness], -1)


CAMERA = "front"  # The model has one unnamed camera.
_STATE = ["xyzrpy"]
_GOAL = "goal"  # key in a session's memory


class Goal:
    """A goal image, and its features once they are computed.

    Copying or pickling it needs no device.
    """

    def __init__(self, pixels: np.ndarray, features: Any = None) -> None:
        self.pixels = pixels  # (3, side, side) float32
        # The features, (N, F) float32: a tensor on the model's device, or an array from a pickle;
        # None before they are computed.
        self.features = features

    def __deepcopy__(self, memo: object) -> Goal:
        return self  # samples of a session copy the session's memory, and share the features

    def __reduce__(self) -> tuple[type[Goal], tuple[np.ndarray, np.ndarray | None]]:
        features = self.features
        if features is not None and not isinstance(features, np.ndarray):
            features = fetch(features)
        return Goal, (self.pixels, features)


# The arrays of a session's observation, which are copied to the device as soon as it arrives.
_PIXELS = "pixels"  # (3, side, side) float32
_POSE = "pose"  # (7,) float32: x, y, z m, roll, pitch, yaw rad, closedness


class WorldModel:
    """The encoder and the predictor.

    Weights and features are float32, although computations may use another type.
    """

    def __init__(
        self,
        encoder: Any,
        predictor: Any,
        config: VJepa2AcConfig,
        dtype: Any,
        compilation: Compilation,
    ) -> None:
        self._encoder, self._predictor = encoder, predictor
        self._encode = compilation.core("encode", self._features)
        # The number of known frames minus 1 -> the compiled predictor of the next frame.
        self._predictors = []
        for frames in range(1, config.rollout + 1):
            name = f"predict frame {frames + 1}"
            self._predictors.append(compilation.core(name, self._predict, config.plans_a_pass))
        self._layer_norm = require("torch").nn.functional.layer_norm
        self._device, self._dtype = encoder.device.type, dtype
        self.staging = Staging(encoder.device)

    def autocast(self) -> Any:
        """Return a context in which computations use `dtype`, as in upstream's training.

        Attention needs weights of a single type.
        """
        torch = require("torch")
        return torch.autocast(self._device, self._dtype, enabled=self._dtype != torch.float32)

    def encode(self, images: Tensor) -> Tensor:
        """Compute features (B, N, F) of still images (B, 3, side, side) float32."""
        return self._encode(images.to(self._encoder.dtype))

    def _features(self, images: Tensor) -> Tensor:
        # The two frames of one time step of the encoder.
        clip = images[:, None].repeat(1, 2, 1, 1, 1)
        encoded = self._encoder(pixel_values_videos=clip, skip_predictor=True)
        return self._normalized(encoded.last_hidden_state.float())

    def _normalized(self, features: Tensor) -> Tensor:
        """Return features (…, F), normalised as in training."""
        return self._layer_norm(features, features.shape[-1:])

    def __call__(self, features: Tensor, actions: Tensor, poses: Tensor) -> Tensor:
        """Predict the features of the next frame (see `World`)."""
        predict = self._predictors[features.shape[1] - 1]
        return predict(features, actions, poses)

    def _predict(self, features: Tensor, actions: Tensor, poses: Tensor) -> Tensor:
        tokens = features.shape[2]
        predicted = self._predictor(features.flatten(1, 2), actions, poses)
        return self._normalized(predicted[:, -tokens:].float())


class VJepa2Ac(ModelPolicy):
    """A policy that moves the gripper until the camera's image equals the goal image.

    The goal image is `info["goal_image"]` in the observation of `reset` or in any later
    observation. It remains valid until the next goal image.
    """

    Config: ClassVar[type] = VJepa2AcConfig
    config: VJepa2AcConfig
    variation = "the goal images of new goals are encoded together"

    def __init__(self, config: VJepa2AcConfig) -> None:
        super().__init__(config)
        self._cameras = choose_cameras(config.cameras, {CAMERA: "front"}, [CAMERA])
        self._state = config.state or _STATE

    @property
    def contract(self) -> Contract:
        return self.make_contract(
            self._cameras,
            [*self._state, GRIPPER],
            self.config.rollout,
            state=state_specs(self._state, 6),
            instruction=None,
            action=ActionSpec(
                dim=7,
                space="ee_pose",
                delta=True,
                rotation="euler_xyz",
                frame="base",
                gripper_open=1.0,
                gripper_closed=0.0,
            ),
            history=None,
        )

    def load(self) -> WorldModel:
        """Read the checkpoint, and the encoder if it is a separate checkpoint.

        Raises:
            ConfigError: A weight is missing, or the settings do not fit the checkpoint.
            MissingDependency: The predictor's code is missing.
        """
        saved = read_checkpoint(self.config)
        device = torch_device(self.config.device)
        # Upstream computes plans in float32.
        dtype = torch_dtype(self.config.dtype, device, preferred="float32")
        encoder = load_encoder(self.config, saved.get("encoder"))
        predictor = load_predictor(self.config, saved["predictor"], encoder.config.hidden_size)
        return WorldModel(
            encoder.to(device).eval(),
            predictor.to(device).eval(),
            self.config,
            dtype,
            self.compilation,
        )

    def notice(self, obs: Obs) -> None:
        """Set the goal image, if an observation has one.

        If the image is unchanged, its features are kept.

        Raises:
            InvalidObservation: The goal is not a valid image.
        """
        image = obs.info.get(GOAL_IMAGE)
        if image is None:
            return
        if (
            not isinstance(image, np.ndarray)
            or image.ndim != 3
            or image.shape[2] != 3
            or image.dtype != np.uint8
        ):
            description = type(image).__name__
            if isinstance(image, np.ndarray):
                description = f"{image.shape} {image.dtype}"
            raise InvalidObservation(
                f"info[{GOAL_IMAGE!r}]: expected (H, W, 3) uint8 RGB, got {description}"
            )

        pixels, memory = to_pixels(image, self.config.image_size), self._current_episode().memory
        if _GOAL not in memory or not np.array_equal(pixels, memory[_GOAL].pixels):
            memory[_GOAL] = Goal(pixels)

    def perceive(self, obs: Obs) -> StagedRow:
        """Return the camera's image in the encoder's format, and the pose with the gripper's
        closedness, and begin to copy them to the device.
        """
        pose = state_vector(obs, [*self._state, GRIPPER], 7)
        pose[6] = 1 - pose[6]
        [image] = camera_images(obs, self._cameras).values()
        world: WorldModel = self.loaded()
        return world.staging.stage({_PIXELS: to_pixels(image, self.config.image_size), _POSE: pose})

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """Compute plans for all rows that have a goal.

        The result of a row without a goal is an error.
        """
        no_goal = InvalidObservation(
            f"info[{GOAL_IMAGE!r}]: expected an image of the goal, (H, W, 3) uint8, got none "
            "since the reset"
        )
        return compute_valid([row if _GOAL in row.memory else no_goal for row in rows], self._plans)

    def _plans(self, rows: Sequence[Row]) -> list[Prediction]:
        torch = require("torch")
        config, world = self.config, self.model
        goals = [row.memory[_GOAL] for row in rows]
        # Samples of a session share a goal, which is encoded once.
        new_goals = [goal for goal in dict.fromkeys(goals) if goal.features is None]
        noise_shape = (config.iterations, config.rollout, config.samples, DRAWN)

        with torch.inference_mode(), world.autocast(), default_attention():
            inputs = world.staging.stack([row.frames[-1] for row in rows])
            features = world.encode(inputs[_PIXELS])
            device = features.device
            if new_goals:
                goal_images = world.staging.upload(np.stack([goal.pixels for goal in new_goals]))
                for goal, goal_features in zip(new_goals, world.encode(goal_images), strict=True):
                    goal.features = goal_features.clone()
            for goal in goals:
                goal.features = torch.as_tensor(goal.features).to(device, non_blocking=True)

            noise = np.stack([row.noise(*noise_shape) for row in rows])
            plans = plan(
                world,
                features,
                inputs[_POSE],
                torch.stack([goal.features for goal in goals]),
                world.staging.upload(noise),
                config,
            )

        actions, std, energy = fetch(plans.actions), fetch(plans.std), fetch(plans.energy)
        predictions = []
        for i, row in enumerate(rows):
            steps = _openings(actions[i], row.frames[-1][_POSE][6])
            info = {"energy": float(energy[i])}
            predictions.append(Prediction(steps, mean=steps, std=std[i], info=info))
        return predictions

    def _example(self, seed: int, instruction: str = "warm up") -> Row:
        example = super()._example(seed, instruction)
        return replace(example, memory={_GOAL: Goal(example.frames[-1][_PIXELS])})


def _openings(actions: np.ndarray, closedness: float) -> np.ndarray:
    """Return a plan with the opening of the gripper after each step, instead of the change of its
    closedness.

    Args:
        actions: The plan, (H, 7); the last column is the change of the gripper's closedness.
        closedness: The closedness at the start.
    """
    converted = actions.copy()
    for action in converted:
        closedness = float(np.clip(closedness + action[6], 0, 1))
        action[6] = 1 - closedness
    return converted
