"""Strict loading of LeRobot checkpoints: missing, unknown or random parts are errors before
serving.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.util
import json
import logging
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.accelerator import ensure_torchvision
from vlagents_ray.policies.base.checkpoint import SavedTensors, find_checkpoint, require_loaded
from vlagents_ray.registry import require
from vlagents_ray_models.lerobot.config import LeRobotConfig, is_new, other_version, refusal
from vlagents_ray_models.lerobot.kinds import KINDS, LONGEST_PREFIX, Diffusion, Flow
from vlagents_ray_models.lerobot.processors import PIPELINES, require_known_steps

logger = logging.getLogger(__name__)

WEIGHTS = "model.safetensors"
TRAINED = "pretrained_model"  # LeRobot's checkpoint folder within the folder of a training step
# Types that need openpi's changes to transformers in LeRobot 0.4.
_PATCHED = {"pi0", "pi05", "pi0_fast"}
_CHECK = "transformers.models.siglip.check"  # a module added by these changes


def find(config: LeRobotConfig) -> Path:
    """Find the folder with config, weights and processors; raises `ConfigError` if there is
    none.
    """
    folder = find_checkpoint(config.checkpoint, config.checkpoint_step)
    if (folder / TRAINED).is_dir():
        folder /= TRAINED
    _require_no_nvidia(folder / "config.json")
    folder = find_checkpoint(str(folder.resolve()), needs=["config.json", WEIGHTS])
    if missing := [name for name in PIPELINES if not (folder / name).is_file()]:
        raise ConfigError(
            f"checkpoint {folder}: misses {missing}, with the normalisation; convert a checkpoint "
            "from before LeRobot had processors by: python -m "
            f"lerobot.processor.migrate_policy_normalization --pretrained-path {folder}"
        )
    if not config.trust_remote_code:
        for name in PIPELINES:
            require_known_steps(folder / name)
    return folder


def load(folder: Path, config: LeRobotConfig, device: Any) -> Any:
    """Load LeRobot's policy to the device, in evaluation mode, with every parameter from the
    checkpoint.
    """
    ensure_torchvision()
    factory = require("lerobot.policies.factory")
    require_served(str(_config(folder / "config.json").get("type", "")), folder)
    settings = _settings(folder, config)
    # As in LeRobot's factory; without it EO-1 loads its backbone from the hub.
    settings.pretrained_path = folder
    as_saved = _prepare(settings, config, device)
    try:
        saved = SavedTensors.open(folder / WEIGHTS)
        policy = factory.get_policy_class(settings.type).from_pretrained(
            str(folder), config=settings
        )
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(
            f"checkpoint {folder}: LeRobot cannot load it as {settings.type!r} ({_said(error)}); "
            f"is it complete? {other_version()}. Without a network, what it names on the hub has "
            "to be in the cache, or to be replaced by `overrides`"
        ) from error
    require_loaded(policy, _as_loaded(policy, saved))
    _warn_of_float32(settings, config, device)
    if config.dtype == "float32":
        policy.float()
    elif as_saved:
        for name, parameter in policy.named_parameters():
            parameter.data = parameter.data.to(
                saved[name].dtype if name in saved else parameter.dtype
            )
    return policy.to(device).eval()


def _settings(folder: Path, config: LeRobotConfig) -> Any:
    """Read the checkpoint's config.json, with `overrides`, as LeRobot's config object."""
    base = require("lerobot.configs.policies").PreTrainedConfig
    require("lerobot.utils.import_utils").register_third_party_plugins()
    try:
        settings = base.from_pretrained(folder)
        known = {one.name for one in dataclasses.fields(settings)}
        if unknown := sorted(set(config.overrides) - known):
            raise ConfigError(f"overrides: got {unknown}, want some of {sorted(known)}")
        words = [f"--{name}={json.dumps(value)}" for name, value in config.overrides.items()]
        return base.from_pretrained(folder, cli_overrides=words) if words else settings
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(
            f"checkpoint {folder}: config.json with overrides {config.overrides} is not LeRobot's "
            f"({_said(error)}); {other_version()}. The types it knows here: "
            f"{sorted(base.get_known_choices())}"
        ) from error


def require_served(name: str, folder: Path) -> None:
    """Raise `ConfigError` unless this environment can load LeRobot's policies of type `name`,
    saved in `folder`.
    """
    if reason := refusal(name):
        raise ConfigError(f"checkpoint {folder}: is a {name!r}, which is not served here: {reason}")
    if name in _PATCHED and not is_new():
        found = None
        with contextlib.suppress(ModuleNotFoundError):
            found = importlib.util.find_spec(_CHECK)
        if found is None:
            raise ConfigError(
                f"checkpoint {folder}: LeRobot's {name!r} needs transformers with openpi's "
                f"changes, which no release has; install the branch that LeRobot's page on {name} "
                "names into this environment, serve it with LeRobot 0.6.1, which does without "
                "(`vlagents-ray env make lerobot06`), by 'openpi' or, for π0, by 'pi0'"
            )


def _prepare(settings: Any, config: LeRobotConfig, device: Any) -> bool:
    """Set the device and types of the policy; return whether its parameters keep their saved
    types.
    """
    if settings.use_peft:
        raise ConfigError(
            "checkpoint: is a PEFT adapter, want whole weights; merge it (merge_and_unload) and "
            "save that, or serve its base with the adapter as one of the deployment's `checkpoints`"
        )
    settings.device = str(device)
    if hasattr(settings, "pretrained_backbone_weights"):
        settings.pretrained_backbone_weights = None  # would be downloaded, only to be replaced
    # Types that `compile` supports.
    if issubclass(KINDS.get(settings.type, object), (Diffusion, Flow)):
        if config.overrides.get("compile_model"):
            raise ConfigError(
                "overrides: got compile_model, want `compile: true` in its place, which is checked"
            )
        settings.compile_model = False
    if issubclass(KINDS.get(settings.type, object), Flow):
        rtc = settings.rtc_config or require("lerobot.policies.rtc.configuration_rtc").RTCConfig()
        mode: dict[str, str] = {}
        # In LeRobot's own rollouts a trained checkpoint is guided by default.
        if getattr(settings, LONGEST_PREFIX, 0):
            mode["mode"] = (config.overrides.get("rtc_config") or {}).get("mode", "trained")
        settings.rtc_config = dataclasses.replace(rtc, enabled=True, debug=False, **mode)
    choices = ["auto", "float32", *(["bfloat16"] if hasattr(settings, "dtype") else [])]
    if config.dtype not in choices:
        raise ConfigError(
            f"dtype: got {config.dtype!r}, LeRobot's {settings.type!r} takes one of {choices}"
        )
    if hasattr(settings, "dtype") and config.dtype != "auto":
        settings.dtype = config.dtype
    if config.dtype == "float32" and hasattr(settings, "use_bf16"):
        settings.use_bf16 = False  # GR00T would otherwise still compute in bfloat16
    as_saved = bool(getattr(settings, "load_vlm_weights", False))
    if as_saved:
        settings.load_vlm_weights = False  # would be downloaded in bfloat16, only to be replaced
    return as_saved


def _warn_of_float32(settings: Any, config: LeRobotConfig, device: Any) -> None:
    """Warn if `auto` is float32 on a GPU, which is the default of LeRobot's configs, not of its
    published models.
    """
    if (
        device.type != "cpu"
        and config.dtype == "auto"
        and getattr(settings, "dtype", None) == "float32"
    ):
        logger.warning(
            "dtype: auto is float32 here, as in the checkpoint's config.json: weights take twice "
            "the memory of bfloat16, and acts at least twice the time; set the policy's dtype: "
            "bfloat16, or dtype: float32 to keep it"
        )


def _said(error: BaseException | None) -> str:
    """Return the text of an error and of its causes, such as that of a config's own check."""
    said = []
    while error is not None:
        said.append(f"{type(error).__name__}: {error}")
        error = error.__cause__ or error.__context__
    return ", from ".join(dict.fromkeys(said))


def _require_no_nvidia(file: Path) -> None:
    """Raise `ConfigError` for a checkpoint of NVIDIA's own GR00T code, which LeRobot accepts
    only as a base.
    """
    if file.is_file() and "gr00t" in str(_config(file).get("model_type", "")).lower():
        raise ConfigError(
            f"checkpoint {file.parent}: is one of NVIDIA's own GR00T code, want one that LeRobot "
            "saved; serve it by the policy gr00t (docs/policies/gr00t.md), or train it on with "
            "LeRobot 0.6 (lerobot-train --policy.type=groot "
            f"--policy.base_model_path={file.parent})"
        )


def _config(file: Path) -> Mapping[str, Any]:
    """Read a config.json, which may be of another library."""
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ConfigError(
            f"checkpoint {file.parent}: {file.name} is no JSON ({error}); copy it again"
        ) from error
    return found if isinstance(found, dict) else {}


def _as_loaded(policy: Any, saved: SavedTensors) -> SavedTensors | Mapping[str, Any]:
    """Return the saved tensors by LeRobot's current names; checkpoints of openpi and LeRobot 0.4
    have older names.
    """
    module = sys.modules[type(policy).__module__]
    names = list(saved)
    older = getattr(module, "_is_vendored_florence_state_dict", None)  # of X-VLA in LeRobot 0.6
    if older is not None and older(dict.fromkeys(names)):
        renamed: Mapping[str, Any] = module._remap_vendored_florence_state_dict(
            {name: saved[name] for name in names}
        )
        return renamed
    return SavedTensors(
        {
            new: functools.partial(saved.__getitem__, name)
            for name in names
            for new in _renamed(policy, name)
        }
    )


def _renamed(policy: Any, name: str) -> list[str]:
    """Return LeRobot's names of a saved tensor; empty if it drops the tensor."""
    if (fix := getattr(policy, "_fix_pytorch_state_dict_keys", None)) is None:
        return [name]
    found = fix({name: require("torch").empty(0)}, policy.config)
    return [new if new.startswith("model.") else f"model.{new}" for new in found]
