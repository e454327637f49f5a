"""Diffusion Policy, with the sessions' real past frames and their own noise."""

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
    """Settings of Diffusion Policy, in addition to those of all models."""

    checkpoint: str = Field(
        min_length=1,
        description="a .ckpt file, or a folder or org/name@COMMIT of the hub, with only one; "
        "`{step}` stands for "
        "checkpoint_step",
    )
    trust_checkpoint: bool = Field(
        default=False,
        description="these checkpoints are pickles, and loading one runs the code that its author "
        "put in: set true if "
        "you trust its origin",
    )
    source_dir: str | None = Field(
        default=None,
        description="a checkout of Diffusion Policy; unset: the installed one, or that of "
        "DIFFUSION_POLICY_SRC",
    )
    dtype: Literal["auto", "float32"] = Field(
        default="auto", description="float32, as its authors compute"
    )
    actions: Literal["chunk", "queue", "ensemble"] = Field(
        default="queue",
        description="as in all models; 'queue' because the model sees the last frames, those "
        "within a chunk too, "
        "which arrive here only if each of them is sent",
    )
    state: list[str] | None = Field(
        default=None,
        description="parts that follow each other as the checkpoint's low_dim keys do; unset: "
        "parts of their names, "
        "'state' for a checkpoint without cameras",
    )
    steps: int | None = Field(
        default=None, ge=1, description="denoising steps; unset: those of the checkpoint"
    )


USUAL_CAMERAS = {  # of the authors' tasks
    "image": "front",
    "agentview_image": "front",
    "robot0_eye_in_hand_image": "wrist",
}
_POSE_NUMBERS = 10  # position, rotation in six numbers, gripper


class DiffusionPolicy(ModelPolicy):
    """The policy of a Diffusion Policy checkpoint, which calls the module's `predict_action` for
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
        network: DiffusionNetwork | None = self.model
        if network is None:
            return Contract(instruction=False)
        parts, sizes = self._parts(network), network.vectors.values()
        own = {part: StateSpec(size) for part, size in zip(parts, sizes, strict=False)}
        state = {"state": own} if self.config.state is None else {}
        action = _action(network.module.action_dim, absolute=network.absolute)
        horizon = network.module.n_action_steps
        return self.stated(
            self._cameras(network), parts, horizon, instruction=False, action=action, **state
        )

    @property
    def state_dim(self) -> int | None:
        return None if self.model is None else sum(self.model.vectors.values())

    def load(self) -> DiffusionNetwork:
        network = DiffusionNetwork.load(self.config)
        self._cameras(network)
        if self.config.compile_on(network.staging.device.type):
            compile_with(network, self.compilation)
        return network

    def perceive(self, obs: Obs) -> StagedRow:
        """Return images (H, W, 3) uint8 and vectors (D,) float32 by the checkpoint's names."""
        network: DiffusionNetwork = self.model
        seen = {
            name: _resized(image, *network.images[name])
            for name, image in camera_images(obs, self._cameras(network)).items()
        }
        vector = state_vector(obs, self._parts(network), self.state_dim)
        ends = np.cumsum([0, *network.vectors.values()])
        parts = {
            name: vector[a:b] for name, (a, b) in zip(network.vectors, pairwise(ends), strict=True)
        }
        return network.staging.stage(seen | parts)

    def predict(self, rows: Sequence[Row]) -> list[Prediction]:
        network: DiffusionNetwork = self.model
        torch, steps = require("torch"), self.history
        frames = [frame for row in rows for frame in row.history(steps)]
        batch = network.staging.stack(frames, keep=steps > 1)
        inputs = {name: tensor.unflatten(0, (len(rows), steps)) for name, tensor in batch.items()}
        for name in network.images:  # (B, T, H, W, 3) uint8 -> (B, T, 3, H, W) in [0, 1]
            inputs[name] = inputs[name].movedim(-1, 2).float() / 255
        from vlagents_ray_models.sampling_rng import RowNoise

        # The scheduler's steps draw in the latter.
        own = network.module, require("diffusers.utils.torch_utils")
        with torch.inference_mode(), RowNoise(rows, network.draws, *own):
            actions = network.module.predict_action(inputs)["action"]
        return [Prediction(chunk) for chunk in fetch(actions.float())]

    def _parts(self, network: DiffusionNetwork) -> list[str]:
        usual = ["state" if name == OBS else name for name in network.vectors]
        return usual if self.config.state is None else self.config.state

    def _cameras(self, network: DiffusionNetwork) -> dict[str, str]:
        usual = {name: ours for name, ours in USUAL_CAMERAS.items() if name in network.images}
        return choose_cameras(self.config.cameras, usual, list(network.images))


def _resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Scale an image, and crop its centre to the model's aspect ratio, as in the authors'
    get_real_obs_dict.
    """
    if image.shape[:2] == (height, width):
        return image.copy()
    transform = require("diffusion_policy.common.cv2_util").get_image_transform
    return np.ascontiguousarray(transform(image.shape[1::-1], (width, height))(image))


def _action(dim: int, *, absolute: bool) -> ActionSpec:
    """Describe the actions; with `abs_action` they are one or two poses in the base frame, with
    6D rotations.
    """
    if not absolute or dim % _POSE_NUMBERS:
        return ActionSpec(dim=dim)
    return ActionSpec(dim=dim, space="ee_pose", delta=False, rotation="rot6d", frame="base")


OBS = "obs"  # the only input of a policy without cameras
_WEIGHTS = "policy.obs_encoder.rgb_model.weights"


@dataclass(frozen=True)
class DiffusionNetwork:
    """The policy's module and its inputs."""

    module: Any
    staging: Staging
    images: dict[str, tuple[int, int]]  # height and width, by the checkpoint's name
    vectors: dict[str, int]  # length, by the checkpoint's name, in its order
    absolute: bool  # poses with 6D rotations, as in the robomimic tasks with `abs_action`
    draws: int  # of noise in a pass, made at once; a pass may need others

    @classmethod
    def load(cls, config: DiffusionPolicyConfig) -> DiffusionNetwork:
        """Read the checkpoint; raises `ConfigError` if it is not trusted, incomplete, or of
        another family.
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
        settings, state = _read(path)
        module = _made(path, settings)
        try:
            module.load_state_dict(state)
        except RuntimeError as error:
            raise ConfigError(
                f"checkpoint {path}: does not fill its own policy: {error}"
            ) from error
        require_loaded(module, state)
        images, vectors = _inputs(module, settings)
        absent = sorted({"action", *images, *vectors} - set(module.normalizer.params_dict.keys()))
        if absent:
            raise ConfigError(
                f"checkpoint {path}: its normalizer has nothing for {absent}, so its numbers have "
                "no units; save it after the workspace has called set_normalizer"
            )
        if config.steps is not None:
            module.num_inference_steps = config.steps
        device = torch_device(config.device)
        absolute = bool(require("omegaconf").OmegaConf.select(settings, "task.abs_action"))
        module.to(device).eval()
        return cls(module, Staging(device), images, vectors, absolute, _draws(module, device))


def checkpoint_file(config: DiffusionPolicyConfig) -> Path:
    """Find the .ckpt file; raises `ConfigError` also for a hub id without a commit, whose pickle
    may change.
    """
    path = find_checkpoint(config.checkpoint, config.checkpoint_step)
    commit = revision(path)
    if commit is not None and commit not in config.checkpoint:
        repository = config.checkpoint.partition("@")[0]
        raise ConfigError(
            f"checkpoint {config.checkpoint!r}: a pickle of the hub, whose branches and tags may "
            f"become others; want the commit that you trust, such as {repository}@{commit}, which "
            "it is now"
        )
    if path.is_file():
        return path
    found = sorted(path.rglob("*.ckpt"))
    if len(found) != 1:
        names = [str(file.relative_to(path)) for file in found[:10]]
        raise ConfigError(
            f"checkpoint {path}: a folder with {names}, want one .ckpt file, or a folder with only "
            "one"
        )
    return find_checkpoint(str(found[0]))


def _read(path: Path) -> tuple[Any, Mapping[str, Any]]:
    """Return the settings of the training and the weights, averaged ones if the training
    computed them.
    """
    torch, dill = require("torch"), require("dill")
    try:
        payload = torch.load(path, map_location="cpu", pickle_module=dill, weights_only=False)
        settings, states = payload["cfg"], payload["state_dicts"]
    except Exception as error:  # unpickling can raise any exception
        raise ConfigError(
            f"checkpoint {path}: got no payload of a Diffusion Policy workspace "
            f"({type(error).__name__}: {error}); want a .ckpt that its save_checkpoint wrote"
        ) from error
    name = (
        "ema_model"
        if require("omegaconf").OmegaConf.select(settings, "training.use_ema")
        else "model"
    )
    if name not in states:
        raise ConfigError(
            f"checkpoint {path}: has no {name!r}, which its training.use_ema needs; has "
            f"{sorted(states)}"
        )
    return settings, states[name]


def _made(path: Path, settings: Any) -> Any:
    omegaconf = require("omegaconf").OmegaConf
    if omegaconf.select(settings, _WEIGHTS) not in (None, "r3m", "R3M"):
        # The initial weights of the training would be downloaded, only to be replaced.
        omegaconf.update(settings, _WEIGHTS, None)
    module = require("hydra.utils").instantiate(settings.policy)
    if not hasattr(module, "noise_scheduler"):
        raise ConfigError(
            f"checkpoint {path}: {type(module).__name__} is no diffusion policy; want one of "
            "diffusion_policy.policy's Diffusion…Policy"
        )
    if any(
        type(part).__name__ == "CropRandomizer" and "robomimic" in type(part).__module__
        for part in module.modules()
    ):
        raise ConfigError(
            f"checkpoint {path}: its encoder crops at random while it acts, so actions would "
            "depend on neighbours; want one trained with eval_fixed_crop: true"
        )
    return module


def _inputs(module: Any, settings: Any) -> tuple[dict[str, tuple[int, int]], dict[str, int]]:
    if (shapes := settings.policy.get("shape_meta")) is None:
        return {}, {OBS: module.obs_dim}
    images = {name: one for name, one in shapes.obs.items() if one.get("type", "low_dim") == "rgb"}
    vectors = {name: one for name, one in shapes.obs.items() if name not in images}
    return (
        {name: (one.shape[1], one.shape[2]) for name, one in images.items()},
        {name: one.shape[0] for name, one in vectors.items()},
    )


def _draws(module: Any, device: Any) -> int:
    """Have the module denoise without waiting for its device, and return how often it then draws
    noise.
    """
    scheduler = module.noise_scheduler
    scheduler.set_timesteps(module.num_inference_steps)
    # Else the loop may be another.
    if type(module).conditional_sample.__module__.startswith("diffusion_policy."):
        module.conditional_sample = partial(
            _conditional_sample, module, scheduler.timesteps.to(device)
        )
    noisy = "variance_type" in scheduler.config  # DDPM's steps add noise, except the last one
    return 1 + noisy * int((scheduler.timesteps > 0).sum())


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
    """Return numbers (B, T, D), denoised as the module's `conditional_sample` does, without waiting
    for a GPU.

    Theirs copies the time to it, and indexes by truth values, at each step. `times` are on the
    device; the scheduler branches on its own, on the CPU. `data` (B, T, D) are not denoised where
    `known`.
    """
    torch, scheduler = require("torch"), module.noise_scheduler
    names = [name for name in ("local_cond", "global_cond") if name in options]
    seen: dict[str, Any] = {name: options.pop(name) for name in names} or {"cond": cond}
    randn = require("diffusers.utils.torch_utils").randn_tensor
    numbers = torch.where(known, data, randn(data.shape, device=data.device, dtype=data.dtype))
    scheduler.set_timesteps(module.num_inference_steps)
    for time, time_there in zip(scheduler.timesteps, times, strict=True):
        output = module.model(numbers, time_there, **seen)
        numbers = scheduler.step(output, time, numbers, generator=generator, **options).prev_sample
        numbers = torch.where(known, data, numbers)
    return numbers


_CONDITIONS = {
    "obs_as_cond": "cond",
    "obs_as_local_cond": "local_cond",
    "obs_as_global_cond": "global_cond",
}


def compile_with(network: DiffusionNetwork, compilation: Compilation) -> None:
    """Compile a module's denoising network and its image encoder, both of which `predict_action`
    calls.
    """
    module = network.module
    _without_branches_on_values(module, network.staging.device)
    condition = next(
        (name for flag, name in _CONDITIONS.items() if getattr(module, flag, False)), ""
    )
    module.model.forward = _denoising(module.model.forward, condition, compilation)
    if (encoder := getattr(module, "obs_encoder", None)) is not None:
        names = [*network.images, *network.vectors]
        encoder.forward = _looking(encoder.forward, names, module.n_obs_steps, compilation)


def _denoising(
    forward: Callable[..., Any], condition: str, compilation: Compilation
) -> Callable[..., Any]:
    """Return the denoising network as its loop calls it; `condition` is the name of its argument
    for observations.
    """

    def denoise(sample: Any, times: Any, *seen: Any) -> Any:
        return forward(sample, times, **dict(zip([condition], seen, strict=False)))

    core = compilation.core("denoise", denoise)

    def call(sample: Any, time: Any, *seen: Any, **named: Any) -> Any:
        given = [one for one in (*seen, *named.values()) if one is not None]
        return core(sample, time.to(sample.device).expand(len(sample)), *given)

    return call


def _looking(
    forward: Callable[..., Any], names: list[str], steps: int, compilation: Compilation
) -> Callable[[Mapping[str, Any]], Any]:
    """Return the encoder of frames (B * steps, …) by name, whose compiled core takes rows of
    `steps` frames.
    """

    def encode_images(*frames: Any) -> Any:
        seen = {name: frame.flatten(0, 1) for name, frame in zip(names, frames, strict=True)}
        return forward(seen).reshape(len(frames[0]), steps, -1)

    core = compilation.core("vision encoder", encode_images)

    def call(seen: Mapping[str, Any]) -> Any:
        return core(*(seen[name].unflatten(0, (-1, steps)) for name in names)).flatten(0, 1)

    return call


def _without_branches_on_values(module: Any, device: Any) -> None:
    """Replace parts of torch that branch on values of tensors, which compiled programs cannot
    do.
    """
    torch, transforms = require("torch"), require("torchvision.transforms")
    for part in module.modules():
        if isinstance(part, transforms.Normalize):  # refuses a std of 0
            mean, std = (
                torch.tensor(numbers, device=device).view(-1, 1, 1)
                for numbers in (part.mean, part.std)
            )
            part.forward = partial(_normalised, mean, std)
        elif isinstance(part, torch.nn.TransformerDecoder):
            # tests whether its mask is causal, for a faster kernel
            part.forward = partial(part.forward, tgt_is_causal=False)
        elif isinstance(part, torch.nn.TransformerEncoder):
            part.forward = partial(part.forward, is_causal=False)


def _normalised(mean: Any, std: Any, image: Any) -> Any:
    return (image - mean) / std
