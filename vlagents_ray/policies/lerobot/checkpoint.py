"""Strict loading of LeRobot checkpoints: missing, unknown or random parts are errors before serving."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import json
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.accelerator import ensure_torchvision
from vlagents_ray.policies.base.checkpoint import SavedTensors, find_checkpoint, require_loaded
from vlagents_ray.policies.lerobot.config import LeRobotConfig
from vlagents_ray.policies.lerobot.policy_types import KINDS, REFUSED, Diffusion, Flow
from vlagents_ray.policies.lerobot.processors import PIPELINES, require_known_steps
from vlagents_ray.registry import require

WEIGHTS = "model.safetensors"
TRAINED = "pretrained_model"  # LeRobot's folder of the checkpoint within that of a training step
_PATCHED = {"pi0", "pi05", "pi0_fast"}  # they need openpi's changes to transformers
_CHECK = "transformers.models.siglip.check"  # a module that these changes add


def find(config: LeRobotConfig) -> Path:
    """Find the folder with config, weights and processors; raises `ConfigError` if there is none."""
    folder = find_checkpoint(config.checkpoint, config.checkpoint_step)
    if (folder / TRAINED).is_dir():
        folder /= TRAINED
    folder = find_checkpoint(str(folder.resolve()), needs=["config.json", WEIGHTS])
    missing = [name for name in PIPELINES if not (folder / name).is_file()]
    if missing:
        raise ConfigError(
            f"checkpoint {folder}: misses {missing}, with the normalisation; convert a checkpoint from before LeRobot "
            f"had processors by: python -m lerobot.processor.migrate_policy_normalization "
            f"--pretrained-path {folder}"
        )
    if not config.trust_remote_code:
        for name in PIPELINES:
            require_known_steps(folder / name)
    return folder


def load(folder: Path, config: LeRobotConfig, device: Any) -> Any:
    """Load LeRobot's policy to the device, in evaluation mode, with every parameter from the checkpoint."""
    ensure_torchvision()
    factory = require("lerobot.policies.factory")
    settings = _settings(folder, config)
    require_served(settings.type, folder)
    as_saved = _prepare(settings, config, device)
    try:
        saved = SavedTensors.of(folder / WEIGHTS)
        policy = factory.get_policy_class(settings.type).from_pretrained(str(folder), config=settings)
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(
            f"checkpoint {folder}: LeRobot cannot load it as {settings.type!r} ({type(error).__name__}: {error}); is "
            f"it complete, and of this version of LeRobot? Without a network, what it names on the hub has to be in "
            f"the cache, or to be replaced by `overrides`"
        ) from error
    require_loaded(policy, saved.renamed(lambda name: _as_loaded(policy, name)))
    if config.dtype == "float32":
        policy.float()
    elif as_saved:
        for name, parameter in policy.named_parameters():
            parameter.data = parameter.data.to(saved[name].dtype if name in saved else parameter.dtype)
    return policy.to(device).eval()


def _settings(folder: Path, config: LeRobotConfig) -> Any:
    """Read the checkpoint's config.json, with `overrides`, as LeRobot's object."""
    base = require("lerobot.configs.policies").PreTrainedConfig
    require("lerobot.utils.import_utils").register_third_party_plugins()
    try:
        settings = base.from_pretrained(folder)
        known = {one.name for one in dataclasses.fields(settings)}
        unknown = sorted(set(config.overrides) - known)
        if unknown:
            raise ConfigError(f"overrides: got {unknown}, want some of {sorted(known)}")
        words = [f"--{name}={json.dumps(value)}" for name, value in config.overrides.items()]
        return base.from_pretrained(folder, cli_overrides=words) if words else settings
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(
            f"checkpoint {folder}: config.json with overrides {config.overrides} is not LeRobot's "
            f"({type(error).__name__}: {error}); the types it knows here: {sorted(base.get_known_choices())}"
        ) from error


def require_served(name: str, folder: Path) -> None:
    """Raise `ConfigError` unless this environment can load LeRobot's policy of that type, saved in `folder`."""
    if name in REFUSED:
        raise ConfigError(f"checkpoint {folder}: is a {name!r}, which is not served here: {REFUSED[name]}")
    if name in _PATCHED:
        found = None
        with contextlib.suppress(ModuleNotFoundError):
            found = importlib.util.find_spec(_CHECK)
        if found is None:
            raise ConfigError(
                f"checkpoint {folder}: LeRobot's {name!r} needs transformers with openpi's changes, which no release "
                f"has; install the branch that LeRobot's page on {name} names into this environment, or serve the "
                f"policy by 'openpi' or, for π0, by 'pi0'"
            )


def _prepare(settings: Any, config: LeRobotConfig, device: Any) -> bool:
    """Set the device and types of the policy; returns whether its parameters keep their saved types."""
    if settings.use_peft:
        raise ConfigError(
            "checkpoint: is a PEFT adapter, want whole weights; merge it (merge_and_unload) and save that, or "
            "serve its base with the adapter as one of the deployment's `checkpoints`"
        )
    settings.device = str(device)
    if hasattr(settings, "pretrained_backbone_weights"):
        settings.pretrained_backbone_weights = None  # they would be downloaded, only to be replaced
    if issubclass(KINDS.get(settings.type, object), (Diffusion, Flow)):  # which `compile` compiles
        if config.overrides.get("compile_model"):
            raise ConfigError("overrides: got compile_model, want `compile: true` in its place, which is checked")
        settings.compile_model = False
    if issubclass(KINDS.get(settings.type, object), Flow):
        rtc = settings.rtc_config or require("lerobot.policies.rtc.configuration_rtc").RTCConfig()
        settings.rtc_config = dataclasses.replace(rtc, enabled=True, debug=False)
    choices = ["auto", "float32", *(["bfloat16"] if hasattr(settings, "dtype") else [])]
    if config.dtype not in choices:
        raise ConfigError(f"dtype: got {config.dtype!r}, LeRobot's {settings.type!r} takes one of {choices}")
    if hasattr(settings, "dtype") and config.dtype != "auto":
        settings.dtype = config.dtype
    as_saved = bool(getattr(settings, "load_vlm_weights", False))
    if as_saved:
        settings.load_vlm_weights = False  # they would be downloaded in bfloat16, only to be replaced
    return as_saved


def _as_loaded(policy: Any, name: str) -> str | None:
    """Return LeRobot's name of a saved tensor, as checkpoints of openpi have older names."""
    fix = getattr(policy, "_fix_pytorch_state_dict_keys", None)
    if fix is not None:
        name = next(iter(fix({name: None}, policy.config)), "")
        name = name if not name or name.startswith("model.") else f"model.{name}"
    return name or None
