"""The checkpoint's processors of observations, actions and leftover actions."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.dataset_contract import BYTES, STATISTICS, DatasetContract
from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.policies.base import Row
from vlagents_ray.policies.base.accelerator import fetch
from vlagents_ray.policies.base.model_inputs import keeping_tokens
from vlagents_ray.policies.base.staging import Staging
from vlagents_ray.registry import require
from vlagents_ray_models.lerobot.config import LeRobotConfig
from vlagents_ray_models.lerobot.samplers import (
    ACTION,
    STATE,
    groot_dataset,
    require_groot_statistics,
)
from vlagents_ray_models.model_code import CURE

PIPELINES = ("policy_preprocessor.json", "policy_postprocessor.json")
_CONFIG = "config.json"

# Registered names of processor steps.
_DEVICE = "device_processor"
_RENAME = "rename_observations_processor"
_TOKENIZER = "tokenizer_processor"
_GROOT_TOKENIZER = "groot_n1_7_vlm_encode_v1"
_ABSOLUTE = (
    "AbsoluteActionsProcessorStep"  # class in LeRobot 0.6 that adds the state to relative actions
)

# Setting with a hub id, or with a folder on the machine where the policy was trained.
_NAME = "tokenizer_name"

# Policy types whose prompts contain the state and therefore differ in each call.
_STATE_IN_PROMPT = ("pi05", "pi0_fast")
# Policy types that tokenize outside of the pre-processor.
_TOKENIZING = ("eo1", "evo1", "fastwam", "molmoact2", "vla_jepa", "wall_x")

# Settings of a policy, apart from its cameras, that change the network although the weights are the
# same.
_NETWORK = (
    "type",
    "n_obs_steps",
    "chunk_size",
    "empty_cameras",
    "tokenizer_max_length",
    "image_resolution",
    "resize_imgs_with_padding",
    "adapt_to_pi_aloha",
    "use_delta_joint_actions_aloha",
    "use_relative_actions",
    "add_image_special_tokens",
    "attention_mode",
    "prefix_length",
    "self_attn_every_n_layers",
    "min_period",
    "max_period",
)

# Mode of normalisation -> the statistics that it needs.
_STATISTICS = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}


class Processors:
    """The pre- and the post-processor of a policy, on the policy's device.

    Args:
        folder: The folder with both pipelines.
        settings: LeRobot's config object of the policy.
        config: The settings of the deployment, with overrides of the steps' settings.
        staging: Copies inputs to the policy's device.

    Raises:
        ConfigError: A pipeline does not load, or `config` overrides a step that does not exist.
    """

    def __init__(
        self, folder: Path, settings: Any, config: LeRobotConfig, staging: Staging
    ) -> None:
        self.staging = staging
        before, after = (_saved_steps(folder / name) for name in PIPELINES)
        unknown = sorted(set(config.processors) - before.keys() - after.keys())
        if unknown:
            raise ConfigError(
                f"processors: expected only the checkpoint's {[sorted(before), sorted(after)]}, "
                f"got {unknown}; correct the names"
            )

        saved_rename_map = before.get(_RENAME, {}).get("rename_map") or {}
        self.rename_map: dict[str, str] = dict(
            saved_rename_map if config.rename_map is None else config.rename_map
        )
        has_tokenizer = _TOKENIZER in before or _GROOT_TOKENIZER in before
        self.instructed = has_tokenizer or settings.type in _TOKENIZING

        before_overrides = {
            _DEVICE: {"device": settings.device},
            _RENAME: {"rename_map": {}},  # `perceive` already uses the policy's names
            **config.processors,
        }
        try:
            factory = require("lerobot.policies.factory")
            self._before, self._after = factory.make_pre_post_processors(
                settings,
                pretrained_path=str(folder),
                preprocessor_overrides=_of_steps(before_overrides, before),
                postprocessor_overrides=_of_steps(config.processors, after),
            )
            for step in self._before.steps:
                getattr(step, "proc", None)  # GR00T's step loads its tokenizer on first use
        except Exception as error:
            raise ConfigError(
                f"checkpoint {folder}: its processors do not load ({type(error).__name__}: "
                f"{error}); a tokenizer that is not here is replaced by processors: "
                f"{{{_TOKENIZER}: {{tokenizer_name: …}}}}, GR00T's by {{{_GROOT_TOKENIZER}: "
                "{model_name: …}}, π0-FAST's second one by {action_tokenizer_processor: "
                "{paligemma_tokenizer_name: …}}"
            ) from error

        if settings.type not in _STATE_IN_PROMPT:
            self._keep_tokens()

        self._is_groot = settings.type == "groot"
        absolute = [
            step for step in self._after.steps if type(step).__name__ == _ABSOLUTE and step.enabled
        ]
        # The step that stores the states of the last batch.
        self._relative = absolute[0].relative_step if absolute else None
        # Whether actions are converted as whole chunks instead of single rows.
        self.whole = self._is_groot or bool(absolute)
        self.inverse = self._make_inverse()

    def statistics(self, key: str) -> dict[str, list[float]]:
        """Return the statistics of a feature of the dataset by name, such as "mean"; empty if there
        are none.
        """
        for step in self._before.steps:
            by_feature = getattr(step, "_tensor_stats", None) or getattr(step, "stats", None) or {}
            statistics = by_feature.get(key)
            if statistics:
                as_tensor = require("torch").as_tensor
                return {
                    name: as_tensor(value).flatten().tolist() for name, value in statistics.items()
                }
        return {}

    def dataset(self) -> DatasetContract | None:
        """Return the contract of the training dataset; None if the dataset has none."""
        contract_bytes = self.statistics(STATISTICS).get(BYTES)
        if contract_bytes is None:
            return groot_dataset(self._before.steps)
        return DatasetContract.from_statistics(contract_bytes)

    def require_statistics(self, settings: Any, inputs: Sequence[str]) -> None:
        """Check that the processors have finite statistics for the features that they normalise.

        Args:
            settings: LeRobot's config object of the policy.
            inputs: The keys of the policy's observations.

        Raises:
            ConfigError: Statistics of an input or of the actions are missing or not finite.
        """
        if self._is_groot:
            require_groot_statistics(self._before.steps, self._after.steps, settings)
            return

        for key in inputs:
            _require_feature_statistics(self._before, key, settings, PIPELINES[0])
        _require_feature_statistics(self._after, ACTION, settings, PIPELINES[1])

    def observe(self, rows: Sequence[Row], steps: int) -> dict[str, Any]:
        """Return the policy's inputs for the last observations of some rows.

        Args:
            rows: B rows with their observations.
            steps: The number of observations of each row, from the newest backwards.

        Returns:
            Tensors (B * steps, …) on the policy's device, under the policy's observation keys.
        """
        frames: list[Any] = []
        instructions: list[str] = []
        for row in rows:
            frames.extend(row.history(steps))
            instructions.extend([row.instruction] * steps)

        batch = self.staging.stack(frames, keep=steps > 1)
        for key, values in batch.items():
            if values.ndim == 4:  # convert images, (…, H, W, 3) uint8 -> (…, 3, H, W) in [0, 1]
                batch[key] = values.permute(0, 3, 1, 2).float() / 255
        batch["task"] = instructions
        return {key: value for key, value in self._before(batch).items() if value is not None}

    def actions(self, chunks: Any) -> np.ndarray:
        """Convert the policy's actions (B, T, D) to (B, T, D') float32, in the robot's units."""
        if self.whole:
            return fetch(self._after(chunks.float()).float())
        flat = self._after(chunks.float().flatten(0, 1))  # single rows, as in LeRobot's own loop
        return fetch(flat.unflatten(0, chunks.shape[:2]).float())

    def leftover(self, row: Row) -> Any:
        """Convert the leftover actions of a row, (H, D'), to the policy's units.

        Returns:
            A tensor (H, D); None if the row has no leftover, or the conversion is not possible.
        """
        if self.inverse is None or row.leftover is None:
            return None

        actions = require("torch").from_numpy(row.leftover)
        if self._relative is not None:  # relative to the state in which the sampled chunk begins
            state = require("torch").from_numpy(row.frames[-1][STATE])
            mask = self._relative._build_mask(actions.shape[-1])
            actions = require("lerobot.processor").to_relative_actions(actions, state[None], mask)
        return self.inverse(actions)

    def width(self, dim: int) -> int:
        """Return D', the number of values of the robot's actions, for a policy with `dim`
        values.
        """
        if self.whole:
            return dim
        return int(self._after(require("torch").zeros(1, dim)).shape[-1])

    def _keep_tokens(self) -> None:
        """Cache the tokens of instructions if they do not depend on other rows of the batch."""
        tokenizer_class = require("lerobot.processor").TokenizerProcessorStep
        for step in self._before.steps:
            if type(step) is tokenizer_class and step.padding == "max_length":
                step._tokenize_text = cached_tokenizer(
                    step.input_tokenizer,
                    self.staging.device,
                    max_length=step.max_length,
                    truncation=step.truncation,
                    padding_side=step.padding_side,
                )

    def _make_inverse(self) -> Any:
        """Return the inverse of the post-processor; None if the post-processor does more than
        unnormalise.
        """
        processor = require("lerobot.processor")
        converters = require("lerobot.processor.converters")

        steps: list[Any] = []
        for step in self._after.steps:
            if isinstance(step, processor.UnnormalizerProcessorStep):
                normalizer = processor.NormalizerProcessorStep(
                    features=step.features,
                    norm_map=step.norm_map,
                    stats=step.stats,
                    eps=step.eps,
                )
                steps.append(normalizer)
            elif not (
                isinstance(step, processor.DeviceProcessorStep) or type(step).__name__ == _ABSOLUTE
            ):
                return None

        return processor.PolicyProcessorPipeline(
            steps=steps,
            to_transition=converters.policy_action_to_transition,
            to_output=converters.transition_to_policy_action,
        )


def _of_steps(overrides: Mapping[str, Any], steps: Mapping[str, Any]) -> dict[str, Any]:
    """Return the overrides for the steps that a pipeline contains."""
    return {name: settings for name, settings in overrides.items() if name in steps}


def _normalisers(pipeline: Any) -> list[Any]:
    """Return the steps of a pipeline that normalise or unnormalise."""
    return [step for step in pipeline.steps if hasattr(step, "norm_map")]


def _require_feature_statistics(pipeline: Any, key: str, settings: Any, file: str) -> None:
    """Raise `ConfigError` if a pipeline lacks finite statistics to normalise a feature.

    Args:
        pipeline: LeRobot's pipeline, which was read from `file`.
        key: The key of the feature.
        settings: LeRobot's config object of the policy.
        file: The name of the pipeline's file, for the error message.
    """
    steps = _normalisers(pipeline)
    modes = steps[0].norm_map if steps else settings.normalization_mapping
    feature = {**settings.input_features, **settings.output_features}[key]
    mode = getattr(modes.get(feature.type), "name", "")
    needed = _STATISTICS.get(mode, ())

    statistics: dict[str, Any] = {}
    for step in steps:
        statistics.update(step._tensor_stats.get(key, {}))

    missing = [
        name for name in needed if name not in statistics or not statistics[name].isfinite().all()
    ]
    if missing:
        raise ConfigError(
            f"checkpoint: {file}: expected finite {missing} of {key!r}, got {sorted(statistics)}; "
            "without them its inputs and actions are wrong: save its processors with the "
            "statistics of its dataset"
        )


def load_processors(
    folder: Path, adapter: Path | None, settings: Any, config: LeRobotConfig, staging: Staging
) -> Processors:
    """Load the processors of a checkpoint, or those that were saved with its adapter.

    The adapter's dataset may have other statistics than the dataset of the checkpoint.

    Args:
        folder: The folder of the checkpoint.
        adapter: The folder of the adapter; None if there is none.
        settings: LeRobot's config object of the policy.
        config: The settings of the deployment.
        staging: Copies inputs to the policy's device.

    Raises:
        ConfigError: The processors do not load, the adapter's folder contains only one of both
            pipelines, its processors are for states or actions of other lengths, or its config of
            the policy describes another network.
    """
    if adapter is None:
        return Processors(folder, settings, config, staging)

    _require_same_network(adapter / _CONFIG, settings, config)
    missing = [name for name in PIPELINES if not (adapter / name).is_file()]
    if len(missing) == len(PIPELINES):
        return Processors(folder, settings, config, staging)
    if missing:
        raise ConfigError(
            f"{adapter}: expected both pipelines as LeRobot saves them, or none of the two, got no "
            f"{missing}; copy it there"
        )

    if not config.trust_remote_code:
        for name in PIPELINES:
            require_known_steps(adapter / name)
    processors = Processors(adapter, settings, config, staging)
    for key, feature in ((STATE, settings.robot_state_feature), (ACTION, settings.action_feature)):
        length = len(processors.statistics(key).get("mean", ()))
        if length and feature is not None and length != feature.shape[0]:
            raise ConfigError(
                f"{adapter}: {key}: expected statistics of {feature.shape[0]} numbers, as the base "
                f"has, got {length}; merge the adapter into its base, and serve that as a "
                "checkpoint of its own"
            )
    return processors


def _require_same_network(file: Path, settings: Any, config: LeRobotConfig) -> None:
    """Raise `ConfigError` if the policy's config in an adapter's folder differs from the base's in
    its cameras or its network.
    """
    if not file.is_file():
        return

    try:
        saved = json.loads(file.read_text(encoding="utf-8"))
        features = saved.get("input_features") or {}
        saved_cameras = [key for key, feature in features.items() if feature["type"] == "VISUAL"]
    except (ValueError, AttributeError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{file}: is no config of a LeRobot policy ({error!r}); copy it again"
        ) from error

    of_adapter: dict[str, Any] = {}
    of_base: dict[str, Any] = {}
    base = {name: getattr(settings, name) for name in _NETWORK if hasattr(settings, name)}
    for name, value in json.loads(json.dumps(base)).items():
        if name not in config.overrides and name in saved and saved[name] != value:
            of_adapter[name], of_base[name] = saved[name], value

    base_cameras = list(settings.image_features)
    if saved_cameras and saved_cameras != base_cameras:
        of_adapter["cameras"], of_base["cameras"] = saved_cameras, base_cameras

    if of_adapter:
        raise ConfigError(
            f"{file}: expected an adapter trained with {of_base}, as the base, got {of_adapter}; "
            "merge the adapter into its base, and serve that as a checkpoint of its own"
        )


def require_known_steps(file: Path) -> None:
    """Check that a pipeline names only processor steps of LeRobot or of installed plug-ins.

    LeRobot imports and calls the "class" of a step without a "registry_name", even if that is
    `subprocess.Popen`.

    Args:
        file: The JSON file of the pipeline.

    Raises:
        ConfigError: A step is any other class.
    """
    steps = json.loads(file.read_text(encoding="utf-8")).get("steps", [])
    for step in steps:
        if "registry_name" not in step and not _is_lerobots(step.get("class")):
            raise ConfigError(
                f"{file}: expected a step with a registry_name, or a processor step in lerobot.*, "
                f"got the class {step.get('class')!r}, which loading the checkpoint would run, "
                f"whatever it is; {CURE}"
            )


def _is_lerobots(path: object) -> bool:
    """Return whether a dotted path refers to a processor step in LeRobot."""
    module, _, class_name = str(path).rpartition(".")
    if not module.startswith("lerobot."):
        return False
    try:
        value = getattr(require(module), class_name, None)
    except (ImportError, MissingDependency):
        return False
    return inspect.isclass(value) and issubclass(value, require("lerobot.processor").ProcessorStep)


def _saved_steps(file: Path) -> dict[str, Mapping[str, Any]]:
    """Return a mapping from the registered name of each step of a pipeline to the step's
    settings.
    """
    steps = json.loads(file.read_text(encoding="utf-8")).get("steps", [])
    settings = {}
    for step in steps:
        name = step.get("registry_name", step.get("class", ""))
        settings[name] = step.get("config", {})
    return settings


def cached_tokenizer(
    tokenizer: Any, device: Any, **settings: Any
) -> Callable[[list[str]], dict[str, Any]]:
    """Return a cached function that converts texts to a tokenizer's tensors, (B, L), on a device.

    All texts are padded to the same length. Otherwise, a row would be padded to the longest text of
    its batch, and would depend on the other rows.

    Args:
        tokenizer: A tokenizer of transformers.
        device: The device of the tensors and of the cache.
        settings: Further arguments of the tokenizer's calls, such as `max_length`.
    """

    @keeping_tokens
    def tokenize(text: str) -> dict[str, Any]:
        tokens = tokenizer([text], padding="max_length", return_tensors="pt", **settings)
        return {name: row.to(device) for name, row in tokens.items()}

    def tokenize_batch(texts: list[str]) -> dict[str, Any]:
        rows = [tokenize(text) for text in texts]
        batch = {}
        for name in rows[0]:
            batch[name] = require("torch").cat([row[name] for row in rows])
        return batch

    return tokenize_batch
