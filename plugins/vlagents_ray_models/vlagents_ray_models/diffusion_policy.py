"""The policy Diffusion Policy. Each session has its own history of frames and its own noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.accelerator import ensure_torchvision, fetch, torch_device
from vlagents_ray.policies.base.checkpoint import find_checkpoint, require_loaded
from vlagents_ray.policies.base.checkpoint_files import revision
from vlagents_ray.policies.base.model_inputs import camera_images, choose_cameras, state_vector
from vlagents_ray.policies.base.staging import StagedRow, Staging
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.registry import require
from vlagents_ray_models.model_code import use_source


class DiffusionPolicyConfig(ModelConfig):
    """Settings of Diffusion Policy, in addition to the settings of all models."""

    checkpoint: str = Field(
        min_length=1,
        description="a .ckpt file, or a folder or hub id (org/name@COMMIT) with a single .ckpt "
        "file; `{step}` stands for checkpoint_step",
    )
    trust_checkpoint: bool = Field(
        default=False,
        description="these checkpoints are pickles, and loading one runs the code that its author "
        "put in: set true if you trust its origin",
    )
    source_dir: str | None = Field(
        default=None,
        description="a checkout of Diffusion Policy; unset: the installed one, or the one that "
        "DIFFUSION_POLICY_SRC names",
    )
    dtype: Literal["auto", "float32"] = Field(
        default="auto", description="float32, as its authors compute"
    )
    actions: Literal["chunk", "queue", "ensemble"] = Field(
        default="queue",
        description="as in all models; 'queue' by default, because the model reads the last "
        "frames, including the frames within a chunk, so that each frame must be sent",
    )
    state: list[str] | None = Field(
        default=None,
        description="parts of the state in the order of the checkpoint's low_dim keys; unset: the "
        "parts with the names of these keys, or 'state' for a checkpoint without cameras",
    )
    steps: int | None = Field(
        default=None, ge=1, description="denoising steps; unset: as many as in the checkpoint"
    )


USUAL_CAMERAS = {  # camera name in the authors' tasks -> our camera
    "image": "front",
    "agentview_image": "front",
    "robot0_eye_in_hand_image": "wrist",
}
_POSE_NUMBERS = 10  # position (3), 6D rotation (6), gripper (1)


class DiffusionPolicy(ModelPolicy):
    """The policy of a Diffusion Policy checkpoint. It calls the module's `predict_action` once for
    a whole batch.
    """

    Config: ClassVar[type] = DiffusionPolicyConfig
    config: DiffusionPolicyConfig
    trainable = "model.module"

    @property
    def history(self) -> int:
        return 1 if self.model is None else int(self.model.module.n_obs_steps)

    @property
    def contract(self) -> Contract:
        """The contract of the checkpoint. Before the checkpoint is loaded, it declares only that
        no instruction is needed.
        """
        network: DiffusionNetwork | None = self.model
        if network is None:
            return Contract(instruction=False)

        state_parts = self._state_parts(network)
        facts: dict[str, Any] = {
            "instruction": False,
            "action": _action_spec(network.module.action_dim, absolute=network.absolute),
        }
        if self.config.state is None:
            widths = network.vectors.values()
            facts["state"] = {
                part: StateSpec(width) for part, width in zip(state_parts, widths, strict=True)
            }
        return self.make_contract(
            self._cameras(network), state_parts, network.module.n_action_steps, **facts
        )

    @property
    def state_dim(self) -> int | None:
        return None if self.model is None else sum(self.model.vectors.values())

    def load(self) -> DiffusionNetwork:
        """Read the checkpoint; raises `ConfigError` for settings that do not fit it."""
        network = DiffusionNetwork.load(self.config)
        self._cameras(network)  # raises an error unless the configured cameras fit
        if self.config.compile_on(network.staging.device.type):
            compile_with(network, self.compilation)
        return network

    def perceive(self, obs: Obs) -> StagedRow:
        """Return images, (H, W, 3) uint8, and vectors, (D,) float32, under the checkpoint's
        names.
        """
        network: DiffusionNetwork = self.model
        inputs: dict[str, np.ndarray] = {}
        for name, image in camera_images(obs, self._cameras(network)).items():
            height, width = network.images[name]
            inputs[name] = _resized(image, height, width)

        vector = state_vector(obs, self._state_parts(network), self.state_dim)
        ends = np.cumsum([0, *network.vectors.values()])
        for name, (start, end) in zip(network.vectors, pairwise(ends), strict=True):
            inputs[name] = vector[start:end]
        return network.staging.stage(inputs)

    def predict(self, rows: Sequence[Row]) -> list[Prediction]:
        """Compute the chunks of all rows in one call of the module. Each row has its own noise."""
        from vlagents_ray_models.sampling_rng import RowNoise

        network: DiffusionNetwork = self.model
        torch = require("torch")
        steps = self.history
        frames: list[StagedRow] = []
        for row in rows:
            frames += row.history(steps)
        batch = network.staging.stack(frames, keep=steps > 1)

        inputs = {name: tensor.unflatten(0, (len(rows), steps)) for name, tensor in batch.items()}
        for name in network.images:  # (B, T, H, W, 3) uint8 -> (B, T, 3, H, W) in [0, 1]
            inputs[name] = inputs[name].movedim(-1, 2).float() / 255

        # The scheduler's steps draw noise in this module of diffusers.
        drawing_modules = (network.module, require("diffusers.utils.torch_utils"))
        with torch.inference_mode(), RowNoise(rows, network.draws, *drawing_modules):
            actions = network.module.predict_action(inputs)["action"]
        return [Prediction(chunk) for chunk in fetch(actions.float())]

    def _state_parts(self, network: DiffusionNetwork) -> list[str]:
        """Return the parts of the robot's state, in the order of the checkpoint's vectors."""
        if self.config.state is not None:
            return self.config.state
        return ["state" if name == OBS else name for name in network.vectors]

    def _cameras(self, network: DiffusionNetwork) -> dict[str, str]:
        """Return our camera for each image of the checkpoint."""
        usual = {name: ours for name, ours in USUAL_CAMERAS.items() if name in network.images}
        return choose_cameras(self.config.cameras, usual, list(network.images))


def _resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Scale an image, (H, W, 3) uint8, to (height, width, 3), and crop its centre to the model's
    aspect ratio, as get_real_obs_dict of the authors does.
    """
    if image.shape[:2] == (height, width):
        return image.copy()

    get_image_transform = require("diffusion_policy.common.cv2_util").get_image_transform
    transform = get_image_transform(image.shape[1::-1], (width, height))
    return np.ascontiguousarray(transform(image))


def _action_spec(dim: int, *, absolute: bool) -> ActionSpec:
    """Describe the actions.

    With `abs_action`, an action contains one or two poses in the base frame, with 6D rotations.
    """
    if not absolute or dim % _POSE_NUMBERS:
        return ActionSpec(dim=dim)
    return ActionSpec(
        dim=dim,
        space="ee_pose",
        delta=False,
        rotation="rot6d",
        rotation_columns=tuple(range(3, dim, _POSE_NUMBERS)),
        frame="base",
    )


OBS = "obs"  # name of the only input of a policy without cameras
# The training setting that names the initial weights of the image encoder.
_INITIAL_WEIGHTS = "policy.obs_encoder.rgb_model.weights"


@dataclass(frozen=True)
class DiffusionNetwork:
    """The policy's module and its inputs."""

    module: Any
    staging: Staging
    images: dict[str, tuple[int, int]]  # name in the checkpoint -> height and width
    vectors: dict[str, int]  # name in the checkpoint -> length, in the checkpoint's order
    # Whether actions are poses with 6D rotations, as in the robomimic tasks with `abs_action`.
    absolute: bool
    draws: int  # number of draws of noise that are made together; a forward pass may need more

    @classmethod
    def load(cls, config: DiffusionPolicyConfig) -> DiffusionNetwork:
        """Read the checkpoint.

        Raises:
            ConfigError: The checkpoint is not trusted, is incomplete, or belongs to another family.
        """
        if not config.trust_checkpoint:
            raise ConfigError(
                f"checkpoint {config.checkpoint!r}: this family's checkpoints are pickles, and "
                "loading one runs whatever code its author put in; set trust_checkpoint: true if "
                "you trust its origin"
            )
        path = checkpoint_file(config)
        ensure_torchvision()
        use_source("diffusion_policy", "DIFFUSION_POLICY_SRC", config.source_dir)

        settings, weights = _read_payload(path)
        module = _make_module(path, settings)
        try:
            module.load_state_dict(weights)
        except RuntimeError as error:
            raise ConfigError(
                f"checkpoint {path}: does not fill its own policy: {error}"
            ) from error
        require_loaded(module, weights)

        images, vectors = _input_shapes(module, settings)
        normalized_names = set(module.normalizer.params_dict.keys())
        absent = sorted({"action", *images, *vectors} - normalized_names)
        if absent:
            raise ConfigError(
                f"checkpoint {path}: its normalizer has nothing for {absent}, so its numbers have "
                "no units; save it after the workspace has called set_normalizer"
            )

        if config.steps is not None:
            module.num_inference_steps = config.steps
        device = torch_device(config.device)
        module.to(device).eval()
        _sample_without_waiting(module, device)
        absolute = bool(require("omegaconf").OmegaConf.select(settings, "task.abs_action"))
        return cls(module, Staging(device), images, vectors, absolute, _noise_draws(module))


def checkpoint_file(config: DiffusionPolicyConfig) -> Path:
    """Find the .ckpt file.

    Raises:
        ConfigError: There is no .ckpt file or more than one, or the checkpoint is a hub id without
            a commit, whose pickle may change.
    """
    path = find_checkpoint(config.checkpoint, config.checkpoint_step)
    commit = revision(path)
    if commit is not None and commit not in config.checkpoint:
        repository = config.checkpoint.partition("@")[0]
        raise ConfigError(
            "checkpoint: expected the commit that you trust, as this is a pickle of the hub, "
            f"whose branches and tags may become others, got {config.checkpoint!r}; name it as "
            f"{repository}@{commit}, which it is now"
        )

    if path.is_file():
        return path
    files = sorted(path.rglob("*.ckpt"))
    if len(files) != 1:
        names = [str(file.relative_to(path)) for file in files[:10]]
        raise ConfigError(
            f"checkpoint {path}: expected one .ckpt file, or a folder with only one, got a folder "
            f"with {names}; name the file"
        )
    return find_checkpoint(str(files[0]))


def _read_payload(path: Path) -> tuple[Any, Mapping[str, Any]]:
    """Return the settings of the training and the weights.

    These are the averaged weights if the training computed them.
    """
    torch = require("torch")
    dill = require("dill")
    try:
        payload = torch.load(path, map_location="cpu", pickle_module=dill, weights_only=False)
        settings, states = payload["cfg"], payload["state_dicts"]
    except Exception as error:  # Unpickling can raise any exception.
        raise ConfigError(
            f"checkpoint {path}: expected a .ckpt that save_checkpoint of a Diffusion Policy "
            f"workspace wrote, got no such payload ({type(error).__name__}: {error})"
        ) from error

    averages = require("omegaconf").OmegaConf.select(settings, "training.use_ema")
    name = "ema_model" if averages else "model"
    if name not in states:
        raise ConfigError(
            f"checkpoint {path}: expected {name!r}, which its training.use_ema needs, got "
            f"{sorted(states)}"
        )
    return settings, states[name]


def _make_module(path: Path, settings: Any) -> Any:
    """Make the policy's module from the settings of its training.

    Raises:
        ConfigError: The module is not a diffusion policy, or crops images at random during
            inference.
    """
    omegaconf = require("omegaconf").OmegaConf
    if omegaconf.select(settings, _INITIAL_WEIGHTS) not in (None, "r3m", "R3M"):
        # The initial weights of the training would be downloaded, although they are replaced later.
        omegaconf.update(settings, _INITIAL_WEIGHTS, None)

    module = require("hydra.utils").instantiate(settings.policy)
    if not hasattr(module, "noise_scheduler"):
        raise ConfigError(
            f"checkpoint {path}: expected one of diffusion_policy.policy's Diffusion…Policy, got "
            f"{type(module).__name__}"
        )

    for submodule in module.modules():
        cls = type(submodule)
        if cls.__name__ == "CropRandomizer" and "robomimic" in cls.__module__:
            raise ConfigError(
                f"checkpoint {path}: expected an encoder trained with eval_fixed_crop: true, got "
                "one that crops at random while it acts, so that actions would depend on "
                "neighbours; train it with that"
            )
    return module


def _input_shapes(module: Any, settings: Any) -> tuple[dict[str, tuple[int, int]], dict[str, int]]:
    """Return the height and width of each image, and the length of each vector, by name."""
    shapes = settings.policy.get("shape_meta")
    if shapes is None:
        return {}, {OBS: module.obs_dim}

    images: dict[str, tuple[int, int]] = {}
    vectors: dict[str, int] = {}
    for name, entry in shapes.obs.items():
        if entry.get("type", "low_dim") == "rgb":
            images[name] = (entry.shape[1], entry.shape[2])
        else:
            vectors[name] = entry.shape[0]
    return images, vectors


def _sample_without_waiting(module: Any, device: Any) -> None:
    """Set the scheduler's time steps, and make the module denoise without waiting for its
    device.
    """
    scheduler = module.noise_scheduler
    scheduler.set_timesteps(module.num_inference_steps)
    # A class that is not from the authors' package may define another loop.
    if type(module).conditional_sample.__module__.startswith("diffusion_policy."):
        module.conditional_sample = partial(
            _conditional_sample, module, scheduler.timesteps.to(device)
        )


def _noise_draws(module: Any) -> int:
    """Return how many times a forward pass draws noise.

    The scheduler's time steps must be set before.
    """
    scheduler = module.noise_scheduler
    if "variance_type" not in scheduler.config:
        return 1
    # Each of DDPM's steps adds noise, except the last one.
    return 1 + int((scheduler.timesteps > 0).sum())


def _conditional_sample(
    module: Any,
    times: Any,
    data: Any,
    known: Any,
    *,
    generator: Any = None,
    cond: Any = None,
    **options: Any,
) -> Any:
    """Denoise as the module's `conditional_sample` does, without waiting for a GPU.

    The module's own loop waits in each step: it copies the time to the device, and indexes with
    boolean masks.

    Args:
        module: The policy's module.
        times: The scheduler's time steps, on the device.
        data: The known values, which are not denoised, (B, T, D).
        known: Where values are known, (B, T, D) bool.
        generator: The generator of the scheduler's noise.
        cond: The observations, unless `options` has "local_cond" or "global_cond".
        options: Further arguments of the network and of the scheduler's `step`.

    Returns:
        The denoised values, (B, T, D).
    """
    torch = require("torch")
    scheduler = module.noise_scheduler
    conditions: dict[str, Any] = {}
    for name in ("local_cond", "global_cond"):
        if name in options:
            conditions[name] = options.pop(name)
    if not conditions:
        conditions["cond"] = cond

    randn = require("diffusers.utils.torch_utils").randn_tensor
    noise = randn(data.shape, device=data.device, dtype=data.dtype)
    sample = torch.where(known, data, noise)

    # The network reads the time on the device, while the scheduler branches on a copy of the time
    # on the CPU.
    scheduler.set_timesteps(module.num_inference_steps)
    for time, device_time in zip(scheduler.timesteps, times, strict=True):
        output = module.model(sample, device_time, **conditions)
        sample = scheduler.step(output, time, sample, generator=generator, **options).prev_sample
        sample = torch.where(known, data, sample)
    return sample


# The flag of a module -> the argument with which its network receives the observations.
_CONDITIONS = {
    "obs_as_cond": "cond",
    "obs_as_local_cond": "local_cond",
    "obs_as_global_cond": "global_cond",
}


def compile_with(network: DiffusionNetwork, compilation: Compilation) -> None:
    """Compile the denoising network and the image encoder of a module, both of which
    `predict_action` calls.

    Args:
        network: The network, whose module is changed.
        compilation: The compilation of the policy.
    """
    module = network.module
    _replace_branches_on_values(module, network.staging.device)

    flags = [flag for flag in _CONDITIONS if getattr(module, flag, False)]
    condition = _CONDITIONS[flags[0]] if flags else ""
    module.model.forward = _compiled_denoiser(module.model.forward, condition, compilation)

    encoder = getattr(module, "obs_encoder", None)
    if encoder is not None:
        names = [*network.images, *network.vectors]
        encoder.forward = _compiled_encoder(encoder.forward, names, module.n_obs_steps, compilation)


def _compiled_denoiser(
    forward: Callable[..., Any], condition: str, compilation: Compilation
) -> Callable[..., Any]:
    """Return the compiled denoising network as a function that the denoising loop can call.

    `condition` is the name of its argument for observations.
    """

    def denoise(sample: Any, times: Any, *observations: Any) -> Any:
        # Without a condition, the sample itself contains the observations.
        return forward(sample, times, **dict(zip([condition], observations, strict=False)))

    core = compilation.core("denoise", denoise)

    def call(sample: Any, time: Any, *args: Any, **options: Any) -> Any:
        times = time.to(sample.device).expand(len(sample))
        observations = [value for value in (*args, *options.values()) if value is not None]
        return core(sample, times, *observations)

    return call


def _compiled_encoder(
    forward: Callable[..., Any], names: list[str], steps: int, compilation: Compilation
) -> Callable[[Mapping[str, Any]], Any]:
    """Return the compiled encoder of named frames, (B * steps, …).

    Its core processes rows of `steps` frames.
    """

    def encode_images(*frames: Any) -> Any:
        inputs = {name: frame.flatten(0, 1) for name, frame in zip(names, frames, strict=True)}
        return forward(inputs).reshape(len(frames[0]), steps, -1)

    core = compilation.core("vision encoder", encode_images)

    def call(inputs: Mapping[str, Any]) -> Any:
        frames = [inputs[name].unflatten(0, (-1, steps)) for name in names]
        return core(*frames).flatten(0, 1)

    return call


def _replace_branches_on_values(module: Any, device: Any) -> None:
    """Replace the methods of torch that branch on values of tensors, which compiled programs
    cannot do.
    """
    torch = require("torch")
    transforms = require("torchvision.transforms")
    for layer in module.modules():
        if isinstance(layer, transforms.Normalize):  # the transform checks for a std of 0
            mean = torch.tensor(layer.mean, device=device).view(-1, 1, 1)
            std = torch.tensor(layer.std, device=device).view(-1, 1, 1)
            layer.forward = partial(_normalised, mean, std)
        elif isinstance(layer, torch.nn.TransformerDecoder):
            # The layer checks whether its mask is causal, to select a faster kernel.
            layer.forward = partial(layer.forward, tgt_is_causal=False)
        elif isinstance(layer, torch.nn.TransformerEncoder):
            layer.forward = partial(layer.forward, is_causal=False)


def _normalised(mean: Any, std: Any, image: Any) -> Any:
    return (image - mean) / std
