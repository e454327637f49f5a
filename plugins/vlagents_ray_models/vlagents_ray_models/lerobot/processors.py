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
from vlagents_ray_models.lerobot.kinds import ACTION, STATE, groot_dataset, require_groot_statistics
from vlagents_ray_models.model_code import CURE

PIPELINES = ("policy_preprocessor.json", "policy_postprocessor.json")
_NAME = "tokenizer_name"  # a hub id, or a folder of the trainer's
_DEVICE, _RENAME, _TOKENIZER = (
    "device_processor",
    "rename_observations_processor",
    "tokenizer_processor",
)
_GROOT_TOKENIZER = "groot_n1_7_vlm_encode_v1"
_NORMALIZERS = ("normalizer_processor", "unnormalizer_processor")
_ABSOLUTE = "AbsoluteActionsProcessorStep"  # of LeRobot 0.6: adds the state to relative actions
_STATE_IN_PROMPT = ("pi05", "pi0_fast")  # their prompts differ at each act
# Types that tokenize elsewhere.
_TOKENIZING = ("eo1", "evo1", "fastwam", "molmoact2", "vla_jepa", "wall_x")
_CONFIG = "config.json"
# Settings of a policy, apart from its cameras, that change the network for the same weights.
_NETWORK = (
    *(
        "type",
        "n_obs_steps",
        "chunk_size",
        "empty_cameras",
        "tokenizer_max_length",
        "image_resolution",
    ),
    *(
        "resize_imgs_with_padding",
        "adapt_to_pi_aloha",
        "use_delta_joint_actions_aloha",
        "add_image_special_tokens",
    ),
    *("attention_mode", "prefix_length", "self_attn_every_n_layers", "min_period", "max_period"),
)
_STATISTICS = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}


class Processors:
    """The pre- and post-processor, on the policy's device; raises `ConfigError` if they are
    incomplete.
    """

    def __init__(
        self, folder: Path, settings: Any, config: LeRobotConfig, staging: Staging
    ) -> None:
        self.staging = staging
        saved = [_saved_steps(folder / name) for name in PIPELINES]
        if unknown := sorted(set(config.processors) - set().union(*saved)):
            raise ConfigError(
                f"processors: got {unknown}, the checkpoint has "
                f"{[sorted(steps) for steps in saved]}"
            )
        self.steps = [list(steps) for steps in saved]  # the registered names, for both pipelines
        self.step_settings = {  # without steps that depend on the dataset or the machine
            name: {
                key: value
                for key, value in step.items()
                if key not in (_NAME, *config.processors.get(name, ()))
            }
            for steps in saved
            for name, step in steps.items()
            if name not in (_DEVICE, _RENAME, *_NORMALIZERS)
        }
        # `perceive` uses the policy's names.
        own = {_DEVICE: {"device": settings.device}, _RENAME: {"rename_map": {}}}
        overrides = {**own, **config.processors}
        trained = saved[0].get(_RENAME, {}).get("rename_map") or {}
        self.rename_map: dict[str, str] = dict(
            trained if config.rename_map is None else config.rename_map
        )
        self.instructed = settings.type in _TOKENIZING or bool(
            {_TOKENIZER, _GROOT_TOKENIZER} & set(saved[0])
        )
        try:
            self._before, self._after = require(
                "lerobot.policies.factory"
            ).make_pre_post_processors(
                settings,
                pretrained_path=str(folder),
                preprocessor_overrides={
                    name: value for name, value in overrides.items() if name in saved[0]
                },
                postprocessor_overrides={
                    name: value for name, value in config.processors.items() if name in saved[1]
                },
            )
            for step in self._before.steps:  # GR00T's loads its tokenizer on first use
                getattr(step, "proc", None)
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
        self._groot = settings.type == "groot"
        absolute = [
            step for step in self._after.steps if type(step).__name__ == _ABSOLUTE and step.enabled
        ]
        # Holds the states of the last batch.
        self._relative = absolute[0].relative_step if absolute else None
        # Whether actions are converted by whole chunks instead of rows.
        self.whole = self._groot or bool(absolute)
        self.inverse = self._inverse()

    def statistics(self, key: str) -> dict[str, list[float]]:
        """Return the statistics of a feature of the dataset; empty if there are none."""
        for step in self._before.steps:
            of_step = getattr(step, "_tensor_stats", None) or getattr(step, "stats", None) or {}
            if found := of_step.get(key):
                return {
                    name: require("torch").as_tensor(value).flatten().tolist()
                    for name, value in found.items()
                }
        return {}

    def normalises(self, feature: Any) -> bool:
        """Return whether the pre-processor normalises that feature by its statistics."""
        maps = [step.norm_map for step in self._before.steps if hasattr(step, "norm_map")]
        return any(getattr(one.get(feature.type), "name", "IDENTITY") != "IDENTITY" for one in maps)

    def dataset(self) -> DatasetContract | None:
        """Return the contract of the dataset of the training; None if it has none."""
        numbers = self.statistics(STATISTICS).get(BYTES)
        return (
            groot_dataset(self._before.steps)
            if numbers is None
            else DatasetContract.from_statistics(numbers)
        )

    def require_statistics(self, settings: Any, inputs: Sequence[str]) -> None:
        """Raise `ConfigError` unless there are statistics for all `inputs` and the actions."""
        if self._groot:
            require_groot_statistics(self._before.steps, self._after.steps, settings)
            return
        features = {**settings.input_features, **settings.output_features}
        for pipeline, keys, file in (
            (self._before, inputs, PIPELINES[0]),
            (self._after, [ACTION], PIPELINES[1]),
        ):
            steps = [step for step in pipeline.steps if hasattr(step, "norm_map")]
            for key in keys:
                modes = steps[0].norm_map if steps else settings.normalization_mapping
                wanted = _STATISTICS.get(getattr(modes.get(features[key].type), "name", ""), ())
                have = {
                    name: value
                    for step in steps
                    for name, value in step._tensor_stats.get(key, {}).items()
                }
                missing = [
                    name for name in wanted if name not in have or not have[name].isfinite().all()
                ]
                if missing:
                    raise ConfigError(
                        f"checkpoint: {file} has no usable {missing} of {key!r}, has "
                        f"{sorted(have)}; without them its inputs and actions are wrong: save its "
                        "processors with the statistics of its dataset"
                    )

    def observe(self, rows: Sequence[Row], steps: int) -> dict[str, Any]:
        """Return the policy's inputs, (rows * steps, …) on its device: the last `steps` frames
        of each row.
        """
        batch = self.staging.stack(
            [frame for row in rows for frame in row.history(steps)], keep=steps > 1
        )
        for key, values in batch.items():
            if values.ndim == 4:
                batch[key] = values.permute(0, 3, 1, 2).float() / 255
        batch["task"] = [row.instruction for row in rows for _ in range(steps)]
        return {key: value for key, value in self._before(batch).items() if value is not None}

    def normalised_state(self, rows: Sequence[Row]) -> Any:
        """Return the last states of rows, (B, D) on the policy's device, in the policy's units."""
        states = self.staging.upload(np.stack([row.frames[-1][STATE] for row in rows]))
        [step] = [step for step in self._before.steps if hasattr(step, "norm_map")]
        return step._normalize_observation({STATE: states}, inverse=False)[STATE]

    def actions(self, chunks: Any) -> np.ndarray:
        """Convert the policy's actions (B, T, D) to (B, T, D') float32, in the robot's units."""
        if self.whole:
            return fetch(self._after(chunks.float()).float())
        flat = self._after(chunks.float().flatten(0, 1))  # rows, as in LeRobot's own loop
        return fetch(flat.unflatten(0, chunks.shape[:2]).float())

    def leftover(self, row: Row) -> Any:
        """Convert the leftover actions of a row, (H, D'), to the policy's units; None if that is
        not possible.
        """
        if self.inverse is None or row.leftover is None:
            return None
        rows = require("torch").from_numpy(row.leftover)
        if self._relative is not None:  # relative to the state in which the sampled chunk begins
            state = require("torch").from_numpy(row.frames[-1][STATE])
            mask = self._relative._build_mask(rows.shape[-1])
            rows = require("lerobot.processor").to_relative_actions(rows, state[None], mask)
        return self.inverse(rows)

    def width(self, dim: int) -> int:
        """Return D', the number of values of the robot's actions, for a policy with `dim`
        values.
        """
        return dim if self.whole else int(self._after(require("torch").zeros(1, dim)).shape[-1])

    def _keep_tokens(self) -> None:
        """Cache the tokens of instructions, if they do not depend on the other rows of a batch."""
        for step in self._before.steps:
            if (
                type(step) is require("lerobot.processor").TokenizerProcessorStep
                and step.padding == "max_length"
            ):
                step._tokenize_text = cached_tokenizer(
                    step.input_tokenizer,
                    self.staging.device,
                    max_length=step.max_length,
                    truncation=step.truncation,
                    padding_side=step.padding_side,
                )

    def _inverse(self) -> Any:
        """Make the inverse of the post-processor, if it only unnormalises."""
        processor, converters = (
            require("lerobot.processor"),
            require("lerobot.processor.converters"),
        )
        steps: list[Any] = []
        for step in self._after.steps:
            if isinstance(step, processor.UnnormalizerProcessorStep):
                steps.append(
                    processor.NormalizerProcessorStep(
                        features=step.features,
                        norm_map=step.norm_map,
                        stats=step.stats,
                        eps=step.eps,
                    )
                )
            elif not (
                isinstance(step, processor.DeviceProcessorStep) or type(step).__name__ == _ABSOLUTE
            ):
                return None
        return processor.PolicyProcessorPipeline(
            steps=steps,
            to_transition=converters.policy_action_to_transition,
            to_output=converters.transition_to_policy_action,
        )


def own_processors(
    folder: Path, settings: Any, config: LeRobotConfig, base: Processors
) -> Processors | None:
    """Return the processors saved with an adapter, whose dataset may have other statistics than the
    base's.

    Args:
        folder: The adapter's folder.
        settings: The policy's own config.
        config: The settings of the policy.
        base: The processors of the base.

    Returns:
        The processors; None if there are none, so that the base's are used.

    Raises:
        ConfigError: They differ from the base's in more than the statistics of state and actions,
            or the policy's config beside them is of another network.
    """
    _require_same_network(folder / _CONFIG, settings, config)
    if not any((folder / name).is_file() for name in PIPELINES):
        return None
    if missing := [name for name in PIPELINES if not (folder / name).is_file()]:
        raise ConfigError(
            f"{folder}: misses {missing}, want both pipelines as LeRobot saves them, or none of "
            "them"
        )
    if not config.trust_remote_code:
        for name in PIPELINES:
            require_known_steps(folder / name)
    own = Processors(folder, settings, config, base.staging)
    features = {**settings.input_features, **settings.output_features}
    own.require_statistics(settings, [key for key in features if key != ACTION])
    changed = {
        key
        for key in features
        if own.normalises(features[key]) and own.statistics(key) != base.statistics(key)
    }
    sizes = [
        [len(one.statistics(key).get("mean", ())) for key in (STATE, ACTION)] for one in (own, base)
    ]
    odd = [
        name for name, one in own.step_settings.items() if base.step_settings.get(name, one) != one
    ]
    allowed = {ACTION} if settings.type in _STATE_IN_PROMPT else {STATE, ACTION}
    other = {
        "steps": own.steps != base.steps,
        f"settings of {odd}": bool(odd),
        "actions relative to the state": own.whole,
        f"numbers {sizes[0]} of state and actions, not {sizes[1]}": sizes[0] != sizes[1],
        f"statistics of {sorted(changed - allowed)}": bool(changed - allowed),
    }
    if any(other.values()):
        said = ", ".join(what for what, differs in other.items() if differs)
        raise ConfigError(
            f"{folder}: its processors have other {said} than those of the base, want the same but "
            f"for the statistics of {sorted(allowed)}; merge the adapter into its base, and serve "
            "that as a checkpoint of its own"
        )
    return own


def _require_same_network(file: Path, settings: Any, config: LeRobotConfig) -> None:
    """Raise `ConfigError` if the policy's config in the adapter's folder has cameras or passes
    unlike the base's.
    """
    if not file.is_file():
        return
    try:
        saved = json.loads(file.read_text(encoding="utf-8"))
        cameras = [
            key
            for key, one in (saved.get("input_features") or {}).items()
            if one["type"] == "VISUAL"
        ]
    except (ValueError, AttributeError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{file}: is no config of a LeRobot policy ({error!r}); copy it again"
        ) from error
    base = {name: getattr(settings, name) for name in _NETWORK if hasattr(settings, name)}
    other = {
        name: [saved[name], value]
        for name, value in json.loads(json.dumps(base)).items()
        if name not in config.overrides and name in saved and saved[name] != value
    }
    if cameras and cameras != list(settings.image_features):
        other["cameras"] = [cameras, list(settings.image_features)]
    if other:
        raise ConfigError(
            f"{file}: was trained with "
            f"{ ({name: theirs for name, (theirs, _) in other.items()}) }, the base with "
            f"{ ({name: ours for name, (_, ours) in other.items()}) }, want the same; merge the "
            "adapter into its base, and serve that as a checkpoint of its own"
        )


def require_known_steps(file: Path) -> None:
    """Raise `ConfigError` if a pipeline names a step that is neither LeRobot's nor an installed
    plugin's.

    LeRobot imports and calls the "class" of a step without a "registry_name", also
    `subprocess.Popen`.
    """
    steps = json.loads(file.read_text(encoding="utf-8")).get("steps", [])
    for name in [step.get("class") for step in steps if "registry_name" not in step]:
        if not _is_lerobots(name):
            raise ConfigError(
                f"{file}: got a step of the class {name!r}, want one with a registry_name, or a "
                "processor step in lerobot.*: loading the checkpoint would run that, whatever it "
                f"is; {CURE}"
            )


def _is_lerobots(name: object) -> bool:
    module, _, cls = str(name).rpartition(".")
    if not module.startswith("lerobot."):
        return False
    try:
        found = getattr(require(module), cls, None)
    except (ImportError, MissingDependency):
        return False
    return inspect.isclass(found) and issubclass(found, require("lerobot.processor").ProcessorStep)


def _saved_steps(file: Path) -> dict[str, Mapping[str, Any]]:
    """Map the registered name of each step of a pipeline to its settings."""
    steps = json.loads(file.read_text(encoding="utf-8")).get("steps", [])
    return {
        step.get("registry_name", step.get("class", "")): step.get("config", {}) for step in steps
    }


def cached_tokenizer(
    tokenizer: Any, device: Any, **settings: Any
) -> Callable[[list[str]], dict[str, Any]]:
    """Return a cached function from texts to a tokenizer's tensors (B, L) on a device.

    All texts are padded to one length; otherwise a row, padded to the longest text of its batch,
    would depend on the other rows.

    Args:
        tokenizer: A tokenizer of transformers.
        device: The device of the tensors, where the cache has them already.
        settings: Further arguments of its calls, such as `max_length`.
    """

    @keeping_tokens
    def tokenized(text: str) -> dict[str, Any]:
        tokens = tokenizer([text], padding="max_length", return_tensors="pt", **settings)
        return {name: row.to(device) for name, row in tokens.items()}

    def call(texts: list[str]) -> dict[str, Any]:
        rows = [tokenized(text) for text in texts]
        return {name: require("torch").cat([row[name] for row in rows]) for name in rows[0]}

    return call
