"""Strict loading of LeRobot checkpoints: missing, unknown or randomly initialized parameters are
errors before serving.
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
from vlagents_ray_models.lerobot.config import (
    LeRobotConfig,
    cure_with_other_version,
    is_new,
    reason_not_served,
)
from vlagents_ray_models.lerobot.processors import PIPELINES, require_known_steps
from vlagents_ray_models.lerobot.samplers import (
    LONGEST_PREFIX,
    SAMPLERS,
    DiffusionSampler,
    FlowSampler,
)

logger = logging.getLogger(__name__)

WEIGHTS = "model.safetensors"
TRAINED = "pretrained_model"  # LeRobot's checkpoint folder within the folder of a training step
# Policy types that need openpi's changes to transformers in LeRobot 0.4.
_PATCHED = {"pi0", "pi05", "pi0_fast"}
_CHECK = "transformers.models.siglip.check"  # a module that these changes add


def find(config: LeRobotConfig) -> Path:
    """Find the folder of a checkpoint, and check that it is complete.

    Args:
        config: The settings of the policy, with the folder or the hub id of the checkpoint.

    Returns:
        The folder with the policy's config, weights and both processor pipelines.

    Raises:
        ConfigError: The folder does not exist, a file is missing, NVIDIA's own GR00T code wrote the
            checkpoint, or a pipeline names code that is not trusted.
    """
    folder = find_checkpoint(config.checkpoint, config.checkpoint_step)
    if (folder / TRAINED).is_dir():
        folder /= TRAINED
    _require_no_nvidia(folder / "config.json")

    folder = find_checkpoint(str(folder.resolve()), needs=["config.json", WEIGHTS])
    missing = [name for name in PIPELINES if not (folder / name).is_file()]
    if missing:
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
    """Load LeRobot's policy, with every parameter from the checkpoint.

    Args:
        folder: The folder of the checkpoint, as returned by `find`.
        config: The settings of the policy.
        device: The torch device of the policy.

    Returns:
        LeRobot's policy object on the device, in evaluation mode.

    Raises:
        ConfigError: LeRobot cannot load the checkpoint, or its weights do not fill the network.
    """
    ensure_torchvision()
    factory = require("lerobot.policies.factory")
    policy_type = str(_read_config(folder / "config.json").get("type", ""))
    require_served(policy_type, folder)

    settings = _read_settings(folder, config)
    # LeRobot's factory also sets this field. Without it, EO-1 loads its backbone from the hub.
    settings.pretrained_path = folder
    keeps_saved_types = _prepare(settings, config, device)

    try:
        saved = SavedTensors.open(folder / WEIGHTS)
        policy_class = factory.get_policy_class(settings.type)
        policy = policy_class.from_pretrained(str(folder), config=settings)
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(
            f"checkpoint {folder}: LeRobot cannot load it as {settings.type!r} "
            f"({_with_causes(error)}); is it complete? {cure_with_other_version()}. Without a "
            "network, what it names on the hub has to be in the cache, or to be replaced by "
            "`overrides`"
        ) from error
    require_loaded(policy, _with_current_names(policy, saved))

    _warn_of_float32(settings, config, device)
    if config.dtype == "float32":
        policy.float()
    elif keeps_saved_types:
        for name, parameter in policy.named_parameters():
            dtype = saved[name].dtype if name in saved else parameter.dtype
            parameter.data = parameter.data.to(dtype)
    return policy.to(device).eval()


def _read_settings(folder: Path, config: LeRobotConfig) -> Any:
    """Read the checkpoint's config.json, with `overrides`, as LeRobot's config object."""
    base = require("lerobot.configs.policies").PreTrainedConfig
    require("lerobot.utils.import_utils").register_third_party_plugins()
    try:
        settings = base.from_pretrained(folder)
        known = {setting.name for setting in dataclasses.fields(settings)}
        unknown = sorted(set(config.overrides) - known)
        if unknown:
            raise ConfigError(f"overrides: expected only {sorted(known)}, got {unknown}")
        if not config.overrides:
            return settings

        arguments = [f"--{name}={json.dumps(value)}" for name, value in config.overrides.items()]
        return base.from_pretrained(folder, cli_overrides=arguments)
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(
            f"checkpoint {folder}: config.json with overrides {config.overrides} is not LeRobot's "
            f"({_with_causes(error)}); {cure_with_other_version()}. The types it knows here: "
            f"{sorted(base.get_known_choices())}"
        ) from error


def require_served(policy_type: str, folder: Path) -> None:
    """Check that this environment can serve a type of LeRobot's policies.

    Args:
        policy_type: The `type` in the checkpoint's config.json.
        folder: The folder of the checkpoint, for the error message.

    Raises:
        ConfigError: The type is not served, or needs another environment.
    """
    reason = reason_not_served(policy_type)
    if reason is not None:
        raise ConfigError(
            f"checkpoint {folder}: its type {policy_type!r} cannot be served here: {reason}"
        )

    if policy_type in _PATCHED and not is_new():
        spec = None
        with contextlib.suppress(ModuleNotFoundError):
            spec = importlib.util.find_spec(_CHECK)
        if spec is None:
            raise ConfigError(
                f"checkpoint {folder}: LeRobot's {policy_type!r} needs transformers with openpi's "
                "changes, which no release has; install the branch that LeRobot's page on "
                f"{policy_type} names into this environment, serve it with LeRobot 0.6.1, which "
                "does without (`vlagents-ray venv create lerobot06`), by 'openpi' or, for π0, by "
                "'pi0'"
            )


def _prepare(settings: Any, config: LeRobotConfig, device: Any) -> bool:
    """Set the device, the types and the compilation of the policy in LeRobot's config object.

    Returns:
        Whether the parameters keep the types in which they were saved.

    Raises:
        ConfigError: The checkpoint is a PEFT adapter, or a setting does not apply to its type.
    """
    if settings.use_peft:
        raise ConfigError(
            "checkpoint: expected whole weights, got a PEFT adapter; set `checkpoint` to its base "
            "and `adapter` to this folder"
        )

    settings.device = str(device)
    if hasattr(settings, "pretrained_backbone_weights"):
        # Otherwise downloaded, although it is replaced later.
        settings.pretrained_backbone_weights = None

    sampler = SAMPLERS.get(settings.type, object)
    if issubclass(sampler, (DiffusionSampler, FlowSampler)):  # the types that `compile` supports
        if config.overrides.get("compile_model"):
            raise ConfigError(
                "overrides: expected no compile_model, got one; set `compile: true` in its place, "
                "which is checked"
            )
        settings.compile_model = False
    if issubclass(sampler, FlowSampler):
        settings.rtc_config = _real_time_chunking(settings, config)

    _set_dtype(settings, config)
    keeps_saved_types = bool(getattr(settings, "load_vlm_weights", False))
    if keeps_saved_types:
        # Otherwise downloaded in bfloat16, although it is replaced later.
        settings.load_vlm_weights = False
    return keeps_saved_types


def _real_time_chunking(settings: Any, config: LeRobotConfig) -> Any:
    """Return LeRobot's settings of real-time chunking, enabled."""
    rtc = settings.rtc_config or require("lerobot.policies.rtc.configuration_rtc").RTCConfig()
    mode: dict[str, str] = {}
    # LeRobot's own rollouts use guidance by default, even for a checkpoint that was trained with
    # prefixes.
    if getattr(settings, LONGEST_PREFIX, 0):
        overrides = config.overrides.get("rtc_config") or {}
        mode["mode"] = overrides.get("mode", "trained")
    return dataclasses.replace(rtc, enabled=True, debug=False, **mode)


def _set_dtype(settings: Any, config: LeRobotConfig) -> None:
    """Set the type of the weights; raise `ConfigError` if the policy does not support it."""
    has_dtype = hasattr(settings, "dtype")
    choices = ["auto", "float32"]
    if has_dtype:
        choices.append("bfloat16")
    if config.dtype not in choices:
        raise ConfigError(
            f"dtype: expected one of {choices} for LeRobot's {settings.type!r}, got "
            f"{config.dtype!r}"
        )

    if has_dtype and config.dtype != "auto":
        settings.dtype = config.dtype
    if config.dtype == "float32" and hasattr(settings, "use_bf16"):
        settings.use_bf16 = False  # otherwise GR00T would still compute in bfloat16


def _warn_of_float32(settings: Any, config: LeRobotConfig, device: Any) -> None:
    """Warn if `auto` selects float32 on a GPU.

    The default in LeRobot's configs is float32, but LeRobot's published models use other types.
    """
    if (
        device.type != "cpu"
        and config.dtype == "auto"
        and getattr(settings, "dtype", None) == "float32"
    ):
        logger.warning(
            "dtype: auto is float32 here, as in the checkpoint's config.json: weights take twice "
            "the memory of bfloat16, and calls at least twice the time; set the policy's dtype: "
            "bfloat16, or dtype: float32 to keep it"
        )


def _with_causes(error: BaseException | None) -> str:
    """Return the text of an error and of its causes, such as a failed check of a config."""
    texts = []
    while error is not None:
        texts.append(f"{type(error).__name__}: {error}")
        error = error.__cause__ or error.__context__
    return ", from ".join(dict.fromkeys(texts))


def _require_no_nvidia(file: Path) -> None:
    """Raise `ConfigError` for a checkpoint of NVIDIA's own GR00T code.

    LeRobot accepts such a checkpoint only as a base for training.
    """
    if file.is_file() and "gr00t" in str(_read_config(file).get("model_type", "")).lower():
        raise ConfigError(
            f"checkpoint {file.parent}: expected one that LeRobot saved, got one of NVIDIA's own "
            "GR00T code; serve it by the policy gr00t (docs/policies/gr00t.md), or train it on "
            "with LeRobot 0.6 (lerobot-train --policy.type=groot "
            f"--policy.base_model_path={file.parent})"
        )


def _read_config(file: Path) -> Mapping[str, Any]:
    """Read a config.json, which may belong to another library.

    The result is empty if the file is not a JSON object.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ConfigError(
            f"checkpoint {file.parent}: {file.name} is no JSON ({error}); copy it again"
        ) from error
    return content if isinstance(content, dict) else {}


def _with_current_names(policy: Any, saved: SavedTensors) -> SavedTensors | Mapping[str, Any]:
    """Return the saved tensors under LeRobot's current names.

    Checkpoints of openpi and of LeRobot 0.4 use older names.
    """
    module = sys.modules[type(policy).__module__]
    saved_names = list(saved)

    # Names of X-VLA's modules in LeRobot 0.6.
    has_older_names = getattr(module, "_is_vendored_florence_state_dict", None)
    if has_older_names is not None and has_older_names(dict.fromkeys(saved_names)):
        tensors = {name: saved[name] for name in saved_names}
        renamed: Mapping[str, Any] = module._remap_vendored_florence_state_dict(tensors)
        return renamed

    readers = {}
    for saved_name in saved_names:
        for name in _current_names(policy, saved_name):
            readers[name] = functools.partial(saved.__getitem__, saved_name)
    return SavedTensors(readers)


def _current_names(policy: Any, saved_name: str) -> list[str]:
    """Return LeRobot's current names of a saved tensor; empty if LeRobot does not use the
    tensor.
    """
    rename = getattr(policy, "_fix_pytorch_state_dict_keys", None)
    if rename is None:
        return [saved_name]

    renamed = rename({saved_name: require("torch").empty(0)}, policy.config)
    return [name if name.startswith("model.") else f"model.{name}" for name in renamed]
