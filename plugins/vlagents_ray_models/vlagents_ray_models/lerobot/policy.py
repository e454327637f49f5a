"""LeRobot's policies with their processors. One forward pass serves many sessions."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.dataset_contract import (
    Centre,
    DatasetContract,
    angles_in,
    centre_between,
    usual_unit,
)
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import GIVEN, Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row, model_inputs
from vlagents_ray.policies.base.accelerator import torch_device
from vlagents_ray.policies.base.staging import StagedRow
from vlagents_ray.policies.flow import OFFERED
from vlagents_ray.policies.outcomes import attempt
from vlagents_ray.registry import require
from vlagents_ray_models.lerobot import checkpoint, samplers
from vlagents_ray_models.lerobot.config import LeRobotConfig
from vlagents_ray_models.lerobot.processors import Processors, load_processors
from vlagents_ray_models.lerobot.samplers import ACTION, STATE
from vlagents_ray_models.model_code import remote_code
from vlagents_ray_models.pi0_passes import Pi0Passes

log = logging.getLogger(__name__)

ENVIRONMENT = "observation.environment_state"
JOINTS, ENVIRONMENT_STATE = "joints", "environment_state"  # default names of parts of `Obs.state`

# Statistics from which the order of the concatenated parts of a state is inferred.
_COMPARED_STATISTICS = ("min", "max", "mean")
_EMPTY = "empty_camera_"  # prefix of the names of cameras that were always masked in training
_FLOWS = sorted(
    name for name, sampler in samplers.SAMPLERS.items() if issubclass(sampler, samplers.FlowSampler)
)


@dataclass(frozen=True, slots=True)
class LoadedLeRobot:
    """A loaded checkpoint, shared by all sessions."""

    sampler: samplers.Sampler
    processors: Processors
    cameras: dict[str, str]  # the policy's observation key -> our camera
    state: list[str]  # parts of the proprioception; empty if the policy has no state
    environment: list[str]  # parts of the environment's state; empty if the policy has none
    contract: Contract
    trained: DatasetContract  # contract of the training dataset; empty if the dataset has none


class LeRobot(ModelPolicy):
    """A policy that the environment's LeRobot loads, selected by the `type` in its checkpoint."""

    Config: ClassVar[type] = LeRobotConfig
    trainable = network = "model.sampler.policy"
    config: LeRobotConfig

    @property
    def contract(self) -> Contract | None:
        return None if self.model is None else self.model.contract

    @property
    def continues_plans(self) -> bool:
        """Whether a chunk continues the executed plan.

        Chunks of a flow do so with `actions: chunk`.
        """
        model: LoadedLeRobot | None = self.model
        if model is None or not isinstance(model.sampler, samplers.FlowSampler):
            return False
        return model.processors.inverse is not None and self.config.actions == "chunk"

    @property
    def longest_prefix(self) -> int:
        """The largest number of rows of the executed plan with which a chunk begins, if the
        checkpoint was trained with such prefixes and is not guided.
        """
        return int(self.model.sampler.longest) if self.continues_plans else 0

    @property
    def history(self) -> int:
        return 1 if self.model is None else self.model.sampler.steps

    @property
    def batched(self) -> bool:
        return bool(self.loaded().sampler.batched)

    @property
    def variation(self) -> str | None:
        reason: str | None = self.loaded().sampler.variation
        return reason

    @property
    def state_dim(self) -> int | None:
        feature = None if self.model is None else self.model.sampler.config.robot_state_feature
        return None if feature is None else int(feature.shape[0])

    def load(self) -> LoadedLeRobot:
        """Read the checkpoint, and set the defaults in `config` that follow from the checkpoint.

        Raises:
            ConfigError: The checkpoint is incomplete or was written by another version of LeRobot,
                or a setting does not apply to its type.
        """
        with remote_code(allowed=self.config.trust_remote_code):
            return self._load(checkpoint.find(self.config))

    def _load(self, folder: Path) -> LoadedLeRobot:
        policy = checkpoint.load(folder, self.config, torch_device(self.config.device))
        settings = policy.config
        sampler_class = samplers.SAMPLERS.get(settings.type, samplers.Sampler)
        sampler = sampler_class(policy, self.compilation)
        self._configure(sampler)
        self.config = _with_defaults(self.config, sampler)

        adapter = None if self.adapter is None else self.adapter.folder
        processors = load_processors(folder, adapter, settings, self.config, sampler.staging)
        model = self._describe(sampler, processors, _training_dataset(settings, processors))
        self.statistics = _ranges(model)
        return model

    def _configure(self, sampler: samplers.Sampler) -> None:
        """Apply the settings that only some types support; raise `ConfigError` for other types."""
        policy_type = sampler.config.type
        if self.config.compile not in (False, "auto") and not self.compilation.cores:
            raise ConfigError(
                f"compile: not for LeRobot's {policy_type!r}; leave it out, or have LeRobot "
                "compile it, where its config has that: overrides: {compile_model: true}"
            )
        passes = getattr(sampler, "passes", None)
        if isinstance(passes, Pi0Passes):
            passes.use_attention(self.config.attention)
        elif self.config.attention == "flex":
            raise ConfigError(
                f"attention flex: expected LeRobot's 'pi0' or 'pi05' for it, got {policy_type!r}; "
                "leave it out"
            )
        if self.config.longest_prefix:
            if not isinstance(sampler, samplers.FlowSampler) or policy_type != "smolvla":
                raise ConfigError(
                    f"longest_prefix: expected LeRobot's 'smolvla' for it, got {policy_type!r}; "
                    "leave it out: the config of a π0.5 contains its own"
                )
            sampler.read_prefixes(self.config.longest_prefix)
        if isinstance(sampler, samplers.FlowSampler):
            sampler.noise_level = self.config.noise_level
        elif self.config.noise_level:
            raise ConfigError(
                f"noise_level: expected 0 for LeRobot's {policy_type!r}, whose actions are not "
                f"computed with a flow, unlike the actions of {_FLOWS}, got "
                f"{self.config.noise_level}"
            )

    def merge_products(self) -> None:
        passes = getattr(self.model.sampler, "passes", None)
        if isinstance(passes, Pi0Passes):
            passes.merge_products()

    def _describe(
        self,
        sampler: samplers.Sampler,
        processors: Processors,
        trained: DatasetContract,
    ) -> LoadedLeRobot:
        """Return the loaded checkpoint with the contract that follows from its training.

        Args:
            sampler: The sampler with the loaded policy.
            processors: The processors of the dataset that `trained` describes.
            trained: The contract of the training dataset.

        Raises:
            ConfigError: The settings name cameras or parts that do not fit, or the processors lack
                statistics.
        """
        settings = sampler.config
        cameras = _cameras(settings, self.config, processors.rename_map, trained.cameras)
        vectors = [key for key in (STATE, ENVIRONMENT) if key in settings.input_features]
        processors.require_statistics(settings, [*cameras, *vectors])

        state: list[str] = []
        if settings.robot_state_feature:
            state = list(self.config.state or trained.state or [JOINTS])
        environment: list[str] = []
        if settings.env_state_feature:
            environment = list(trained.environment or [ENVIRONMENT_STATE])

        contract = Contract(
            cameras={name: _camera(settings, key) for key, name in cameras.items()},
            state=_state_specs(settings, state, environment, trained),
            gripper=model_inputs.needs_gripper(state),
            instruction=processors.instructed or None,
            action=_action_spec(settings, processors.width(sampler.dim), trained),
            control_hz=trained.contract.control_hz,
            chunk=self.chunk(sampler.horizon),
            history=sampler.steps,
            behaviour=self.offered(OFFERED if self.config.noise_level else ()),
        )
        return LoadedLeRobot(sampler, processors, cameras, state, environment, contract, trained)

    def perceive(self, obs: Obs) -> StagedRow:
        """Return the images, (H, W, 3) uint8, and the state vectors, (D,), of an observation under
        the policy's observation keys.
        """
        model: LoadedLeRobot = self.model
        images = model_inputs.camera_images(obs, model.cameras)
        inputs = {key: image.copy() for key, image in images.items()}
        if model.state:
            state = model_inputs.state_vector(obs, model.state, self.state_dim)
            inputs[STATE] = model.trained.wrapped(state)
        if model.environment:
            width = int(model.sampler.config.env_state_feature.shape[0])
            inputs[ENVIRONMENT] = model_inputs.state_vector(obs, model.environment, width)
        return model.sampler.staging.stage(inputs)

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """Compute the chunks of rows.

        Rows whose inputs have the same shapes share a forward pass.
        """
        if not self.model.sampler.batched:  # an error affects only its own session
            return [attempt(lambda row: self._draw([row])[0], row) for row in rows]

        by_shapes: dict[Any, list[int]] = {}
        for i, row in enumerate(rows):
            shapes = tuple(array.shape for array in row.frames[-1].values())
            by_shapes.setdefault(shapes, []).append(i)

        predictions: dict[int, Prediction | Exception] = {}
        for indices in by_shapes.values():
            drawn = self._draw(self.with_fillers([rows[i] for i in indices]))
            predictions.update(zip(indices, drawn, strict=False))
        return [predictions[i] for i in range(len(rows))]

    def _draw(self, rows: list[Row]) -> list[Prediction]:
        torch = require("torch")
        model: LoadedLeRobot = self.model
        sampler, settings = model.sampler, model.sampler.config

        leftovers = [model.processors.leftover(row) for row in rows]

        # LeRobot's own loop does the same.
        mixed_precision = settings.use_amp and torch.device(settings.device).type == "cuda"
        with torch.inference_mode(), torch.autocast("cuda", enabled=mixed_precision):
            observed = [rows[i] for i in sampler.observed_rows(rows)]
            inputs = model.processors.observe(observed, sampler.steps)
            chunks = model.processors.actions(sampler.draw(inputs, rows, leftovers))

            behaviours: dict[int, dict[str, Any]] = {}
            if sampler.random_steps is not None:
                dim = settings.action_feature.shape[0]
                behaviours = sampler.random_steps.outputs(self.config.execute, dim)

        predictions = []
        for i, chunk in enumerate(chunks):
            info = {GIVEN: sampler.prefix_rows[i]} if i in sampler.prefix_rows else {}
            predictions.append(Prediction(chunk, behaviour=behaviours.get(i, {}), info=info))
        return predictions


def _with_defaults(config: LeRobotConfig, sampler: samplers.Sampler) -> LeRobotConfig:
    """Return the settings, with the checkpoint's values as defaults."""
    coefficient = getattr(sampler.config, "temporal_ensemble_coeff", None)
    defaults: dict[str, Any] = {}
    if config.actions != "ensemble":
        defaults["execute"] = sampler.default_execute
    # The policy was trained on consecutive frames, so it also needs the frames within a chunk.
    if sampler.steps > 1:
        defaults["actions"] = "queue"
    # n_action_steps is 1 in this case, since LeRobot runs the policy at every tick.
    if coefficient is not None:
        defaults = {"actions": "ensemble", "ensemble_m": coefficient, "execute": None}

    if (config.execute or 0) > sampler.horizon:
        raise ConfigError(
            f"execute: expected at most the {sampler.horizon} rows of the checkpoint's chunks "
            f"from the observation on, got {config.execute}"
        )
    unset = {name: default for name, default in defaults.items() if not _is_set(config, name)}
    return config.model_copy(update=unset)


def _is_set(config: LeRobotConfig, name: str) -> bool:
    return name in config.model_fields_set


def _ranges(model: LoadedLeRobot) -> dict[str, Any] | None:
    """Return `HasStatistics.statistics`, the ranges of the state and the actions in training.

    The state is omitted if its angles are wrapped, and the actions are omitted if they are relative
    to the state.
    """
    comparable = []
    if not model.trained.angles:
        comparable.append(STATE)
    if not model.processors.whole:
        comparable.append(ACTION)

    ranges: dict[str, Any] = {}
    for key in comparable:
        statistics = model.processors.statistics(key)
        for bounds in (("min", "max"), ("q01", "q99")):
            if all(_is_finite(statistics.get(bound)) for bound in bounds):
                ranges[key] = {bound: statistics[bound] for bound in bounds}
                break
    return {"parts": model.state, **ranges} if ranges else None


def _is_finite(values: Sequence[float] | None) -> bool:
    """Return whether there are values and all of them are finite."""
    return bool(values) and bool(np.isfinite(values).all())  # type: ignore[arg-type]


def _training_dataset(settings: Any, processors: Processors) -> DatasetContract:
    """Return the contract of the checkpoint's dataset.

    If the dataset has no contract, it is inferred from the dataset's features. The result is empty
    if the contract cannot be inferred, or does not fit the policy.
    """
    state_feature, dataset = settings.robot_state_feature, processors.dataset()
    if dataset is None:
        if state_feature is None:
            return DatasetContract(Contract())
        return _infer_from_features(settings.input_features, processors)

    if state_feature is None or dataset.width == state_feature.shape[0]:
        return dataset
    log.warning(
        "the contract of the checkpoint's dataset has %d numbers of state, the policy accepts %d: "
        "the contract is not used; set `state` to the parts that the policy was trained with",
        dataset.width,
        state_feature.shape[0],
    )
    return DatasetContract(Contract())


def _infer_from_features(features: Iterable[str], processors: Processors) -> DatasetContract:
    """Infer the parts of the state, and its angles, from features and their statistics.

    Datasets that LeRobot's tools copy without some episodes have no contract. The parts are the
    features other than `observation.state`. Their order is found by comparing their statistics with
    the statistics of `observation.state`.

    Args:
        features: The keys of the dataset's features, in their order.
        processors: The processors with the features' statistics.

    Returns:
        A contract with the parts; an empty one if no order fits.
    """
    features = list(features)
    key_of = {key.removeprefix(f"{STATE}."): key for key in features if key.startswith(f"{STATE}.")}
    gripper_key = f"observation.{model_inputs.GRIPPER}"
    if gripper_key in features:
        key_of[model_inputs.GRIPPER] = gripper_key

    state_statistics = processors.statistics(STATE)
    part_statistics = {name: processors.statistics(key) for name, key in key_of.items()}
    as_listed = sorted(key_of, key=lambda name: features.index(key_of[name]))
    gripper_last = sorted(key_of, key=lambda name: (name == model_inputs.GRIPPER, name))
    for order in (as_listed, gripper_last):
        if order and _fits(order, part_statistics, state_statistics):
            break
    else:
        return DatasetContract(Contract())

    angles: dict[int, Centre] = {}
    first = 0  # index of the part's first value in the state
    for name in order:
        width = len(part_statistics[name]["mean"])
        for i in angles_in(name, usual_unit(name), width):
            index = first + i
            centre = centre_between(state_statistics["min"][index], state_statistics["max"][index])
            if centre is not None:
                angles[index] = centre
        first += width
    return DatasetContract(Contract(), tuple(order), angles=angles)


def _fits(
    order: Sequence[str],
    part_statistics: Mapping[str, Mapping[str, list[float]]],
    state_statistics: Mapping[str, list[float]],
) -> bool:
    """Return whether the concatenated statistics of the parts, in this order, equal the
    statistics of the state.
    """
    for statistic in _COMPARED_STATISTICS:
        joined = np.concatenate([part_statistics[name].get(statistic, []) for name in order])
        expected = state_statistics.get(statistic, [])
        if len(joined) != len(expected):
            return False
        if not np.allclose(joined, expected, rtol=1e-5, atol=1e-6):
            return False
    return True


def _cameras(
    settings: Any, config: LeRobotConfig, renames: dict[str, str], trained: Mapping[str, str]
) -> dict[str, str]:
    """Return a mapping from the policy's observation key of each camera that is not masked to our
    camera.

    Args:
        settings: LeRobot's config object of the policy.
        config: The settings of the deployment.
        renames: The mapping from the dataset's cameras to the policy's observation keys.
        trained: The mapping from the dataset's camera features to our cameras, as far as the
            dataset's contract contains them.

    Raises:
        ConfigError: `cameras` or `masked_cameras` names cameras that the policy does not have, or
            the policy cannot mask cameras.
    """
    name_of = {key: _short(key) for key in settings.image_features if _EMPTY not in key}
    known = sorted(name_of.values())
    unknown = sorted(set(config.masked_cameras) - set(known))
    if unknown:
        raise ConfigError(f"masked_cameras: expected only {known}, got {unknown}")
    if config.masked_cameras and settings.type not in samplers.MASKING:
        raise ConfigError(
            f"masked_cameras: expected none, as LeRobot's {settings.type!r} needs all its "
            f"cameras, {known}, unlike {sorted(samplers.MASKING)}, got {config.masked_cameras}; "
            "leave it out"
        )

    used = {key: name for key, name in name_of.items() if name not in config.masked_cameras}
    sources = {renamed: source for source, renamed in renames.items()}
    defaults = {}
    for key, name in used.items():
        feature = sources.get(key, key)  # key of the camera in the dataset
        defaults[name] = trained.get(feature, _short(feature))
    chosen = model_inputs.choose_cameras(config.cameras, defaults, list(used.values()))
    return {key: chosen[name] for key, name in used.items()}


def _short(key: str) -> str:
    """Return the part of an observation key that is the camera's name."""
    return key.removeprefix("observation.images.").removeprefix("observation.")


def _camera(settings: Any, key: str) -> CameraSpec:
    """Specify a camera.

    Its images may have any size if the policy resizes them; otherwise they must have the size used
    in training.
    """
    if (
        settings.type in samplers.RESIZING
        or getattr(settings, "resize_imgs_with_padding", None) is not None
    ):
        return CameraSpec()
    _, height, width = settings.input_features[key].shape
    return CameraSpec(height, width)


def _state_specs(
    settings: Any, state: Sequence[str], environment: Sequence[str], trained: DatasetContract
) -> dict[str, StateSpec]:
    """Specify the parts of the state and of the environment's state.

    If the training dataset has the same parts, its specification is used.
    """
    known = trained.contract.state or {}
    specs: dict[str, StateSpec] = {}
    if state:
        specs |= model_inputs.state_specs(state, settings.robot_state_feature.shape[0])
    if tuple(state) == trained.state:
        specs |= known
    if environment:
        width = settings.env_state_feature.shape[0]
        for name, spec in model_inputs.state_specs(environment, width).items():
            specs[name] = known.get(name, spec)
    return specs


def _action_spec(settings: Any, width: int, trained: DatasetContract) -> ActionSpec:
    """Specify an action of `width` numbers.

    If the actions of the training dataset have the same number of values, its specification is
    used.
    """
    action = trained.contract.action
    if action.dim != width:
        action = ActionSpec(dim=width)
    names = getattr(settings, "action_feature_names", None) or ()
    if len(names) == width:
        action = replace(action, names=tuple(names))
    return action
