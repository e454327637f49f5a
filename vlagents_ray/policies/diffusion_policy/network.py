"""The policy module of a checkpoint of Diffusion Policy's training workspaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.accelerator import ensure_torchvision, torch_device
from vlagents_ray.policies.base.checkpoint import find_checkpoint, require_loaded
from vlagents_ray.policies.base.checkpoint_files import revision
from vlagents_ray.policies.base.model_code import use_source
from vlagents_ray.policies.diffusion_policy.config import DiffusionPolicyConfig
from vlagents_ray.registry import require

OBS = "obs"  # the only input of a policy without cameras
_WEIGHTS = "policy.obs_encoder.rgb_model.weights"


@dataclass(frozen=True)
class DiffusionNetwork:
    """The policy's module and its inputs."""

    module: Any
    device: Any
    images: dict[str, tuple[int, int]]  # height and width, by the checkpoint's name
    vectors: dict[str, int]  # length, by the checkpoint's name, in its order
    absolute: bool  # poses with rotations in six numbers, as in the robomimic tasks with `abs_action`

    @classmethod
    def load(cls, config: DiffusionPolicyConfig) -> DiffusionNetwork:
        """Read the checkpoint; raises `ConfigError` if it is not trusted, incomplete, or of another family."""
        if not config.trust_checkpoint:
            raise ConfigError(
                f"checkpoint {config.checkpoint!r}: this family's checkpoints are pickles, and loading one runs "
                f"whatever code its author put in; set trust_checkpoint: true if you trust its origin"
            )
        path = checkpoint_file(config)
        ensure_torchvision()
        use_source("diffusion_policy", "DIFFUSION_POLICY_SRC", config.source_dir)
        settings, state = _read(path)
        module = _made(path, settings)
        try:
            module.load_state_dict(state)
        except RuntimeError as error:
            raise ConfigError(f"checkpoint {path}: does not fill its own policy: {error}") from error
        require_loaded(module, state)
        images, vectors = _inputs(module, settings)
        absent = sorted({"action", *images, *vectors} - set(module.normalizer.params_dict.keys()))
        if absent:
            raise ConfigError(
                f"checkpoint {path}: its normalizer has nothing for {absent}, so its numbers have no units; save it "
                f"after the workspace has called set_normalizer"
            )
        if config.steps is not None:
            module.num_inference_steps = config.steps
        device = torch_device(config.device)
        absolute = bool(require("omegaconf").OmegaConf.select(settings, "task.abs_action"))
        return cls(module.to(device).eval(), device, images, vectors, absolute)


def checkpoint_file(config: DiffusionPolicyConfig) -> Path:
    """Find the .ckpt file.

    Raises:
        ConfigError: There is none, a folder has several, or it is of a hub id without the commit, whose pickle may be
            another one tomorrow than the one that the user trusts.
    """
    path = find_checkpoint(config.checkpoint, config.checkpoint_step)
    commit = revision(path)
    if commit is not None and commit not in config.checkpoint:
        repository = config.checkpoint.partition("@")[0]
        raise ConfigError(
            f"checkpoint {config.checkpoint!r}: a pickle of the hub, whose branches and tags may become others; want "
            f"the commit that you trust, such as {repository}@{commit}, which it is now"
        )
    if path.is_file():
        return path
    found = sorted(path.rglob("*.ckpt"))
    if len(found) != 1:
        names = [str(file.relative_to(path)) for file in found[:10]]
        raise ConfigError(f"checkpoint {path}: a folder with {names}, want one .ckpt file, or a folder with only one")
    return find_checkpoint(str(found[0]))


def _read(path: Path) -> tuple[Any, Mapping[str, Any]]:
    """Return the settings of the training and the weights, averaged ones if the training computed them."""
    torch, dill = require("torch"), require("dill")
    try:
        payload = torch.load(path, map_location="cpu", pickle_module=dill, weights_only=False)
        settings, states = payload["cfg"], payload["state_dicts"]
    except Exception as error:  # unpickling can raise any exception
        raise ConfigError(
            f"checkpoint {path}: got no payload of a Diffusion Policy workspace ({type(error).__name__}: {error}); "
            f"want a .ckpt that its save_checkpoint wrote"
        ) from error
    name = "ema_model" if require("omegaconf").OmegaConf.select(settings, "training.use_ema") else "model"
    if name not in states:
        raise ConfigError(f"checkpoint {path}: has no {name!r}, which its training.use_ema wants; has {sorted(states)}")
    return settings, states[name]


def _made(path: Path, settings: Any) -> Any:
    omegaconf = require("omegaconf").OmegaConf
    if omegaconf.select(settings, _WEIGHTS) not in (None, "r3m", "R3M"):
        # The initial weights of the training would be downloaded, only to be replaced.
        omegaconf.update(settings, _WEIGHTS, None)
    module = require("hydra.utils").instantiate(settings.policy)
    if not hasattr(module, "noise_scheduler"):
        raise ConfigError(
            f"checkpoint {path}: {type(module).__name__} is no diffusion policy; want one of diffusion_policy.policy's "
            f"Diffusion…Policy"
        )
    if any(
        type(part).__name__ == "CropRandomizer" and "robomimic" in type(part).__module__ for part in module.modules()
    ):
        raise ConfigError(
            f"checkpoint {path}: its encoder crops at random while it acts, so actions would depend on neighbours; "
            f"want one trained with eval_fixed_crop: true"
        )
    return module


def _inputs(module: Any, settings: Any) -> tuple[dict[str, tuple[int, int]], dict[str, int]]:
    shapes = settings.policy.get("shape_meta")
    if shapes is None:
        return {}, {OBS: module.obs_dim}
    images = {name: one for name, one in shapes.obs.items() if one.get("type", "low_dim") == "rgb"}
    vectors = {name: one for name, one in shapes.obs.items() if name not in images}
    return (
        {name: (one.shape[1], one.shape[2]) for name, one in images.items()},
        {name: one.shape[0] for name, one in vectors.items()},
    )
