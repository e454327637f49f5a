"""LeRobot's policies with their processors, with one forward pass for many sessions."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract
from vlagents_ray.dataset_contract import DatasetContract, angles_in, centre_between, usual_unit
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import GIVEN, Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row, model_inputs
from vlagents_ray.policies.base.accelerator import torch_device
from vlagents_ray.policies.base.staging import StagedRow
from vlagents_ray.policies.flow import OFFERED
from vlagents_ray.policies.outcomes import attempt
from vlagents_ray.registry import require
from vlagents_ray_models.lerobot import checkpoint, kinds
from vlagents_ray_models.lerobot.config import LeRobotConfig
from vlagents_ray_models.lerobot.kinds import ACTION, STATE
from vlagents_ray_models.lerobot.processors import Processors, adapter_processors
from vlagents_ray_models.model_code import remote_code

log = logging.getLogger(__name__)

ENVIRONMENT = "observation.environment_state"
JOINTS, ENVIRONMENT_STATE = "joints", "environment_state"  # default parts of `Obs.state`
_MATCHED = ("min", "max", "mean")  # statistics by which the parts of a state are located in it
_FLOWS = sorted(name for name in kinds.KINDS if issubclass(kinds.KINDS[name], kinds.Flow))
_EMPTY = "empty_camera_"  # prefix of cameras that were always masked in training


@dataclass(frozen=True, slots=True)
class LoadedLeRobot:
    """A loaded checkpoint, shared by all sessions."""

    kind: kinds.Kind
    processors: Processors
    cameras: dict[str, str]  # the policy's observation key -> our name
    state: list[str]  # parts of the proprioception; empty if the policy has no state
    environment: list[str]  # parts of the environment's state; empty if the policy has none
    contract: Contract
    trained: DatasetContract  # of the dataset; empty if the dataset states none
    renames: dict[str, str]  # from the dataset's cameras to the policy's observation keys
    # Of adapters that were trained with other statistics.
    own: dict[str, Processors] = field(default_factory=dict)


class LeRobot(ModelPolicy):
    """A policy that the environment's LeRobot loads, selected by the `type` in its checkpoint."""

    Config: ClassVar[type] = LeRobotConfig
    trainable = network = "model.kind.policy"
    adaptable = True
    config: LeRobotConfig

    @property
    def contract(self) -> Contract | None:
        return None if self.model is None else self.model.contract

    @property
    def continues_plans(self) -> bool:
        loaded: LoadedLeRobot | None = self.model
        if loaded is None or not isinstance(loaded.kind, kinds.Flow):
            return False
        return loaded.processors.inverse is not None and self.config.actions == "chunk"

    @property
    def history(self) -> int:
        return 1 if self.model is None else self.model.kind.steps

    @property
    def state_dim(self) -> int | None:
        feature = None if self.model is None else self.model.kind.config.robot_state_feature
        return None if feature is None else int(feature.shape[0])

    def load(self) -> LoadedLeRobot:
        with remote_code(allowed=self.config.trust_remote_code):
            return self._loaded(checkpoint.find(self.config))

    def _loaded(self, folder: Path) -> LoadedLeRobot:
        policy = checkpoint.load(folder, self.config, torch_device(self.config.device))
        settings = policy.config
        kind = kinds.KINDS.get(settings.type, kinds.Kind)(policy, self.compilation)
        if self.config.compile not in (False, "auto") and not self.compilation.cores:
            raise ConfigError(
                f"compile: not for LeRobot's {settings.type!r}; leave it out, or have LeRobot "
                "compile it, where its config has that: overrides: {compile_model: true}"
            )
        if isinstance(kind, kinds.Flow):
            kind.noise_level, kind.passes.adapters = self.config.noise_level, self.adapters
        elif self.config.adapters:
            raise ConfigError(
                f"adapters: got them for LeRobot's {settings.type!r}, want one of {_FLOWS}; merge "
                "each into its base"
            )
        elif self.config.noise_level:
            raise ConfigError(
                f"noise_level: got {self.config.noise_level} for LeRobot's {settings.type!r}, want "
                f"0, as its actions come out of no flow; those of {_FLOWS} do"
            )
        self.config = _with_defaults(self.config, kind)
        processors = Processors(folder, settings, self.config, kind.staging)
        loaded = self._described(
            kind, processors, _trained(settings, processors), processors.rename_map
        )
        self.statistics = _ranges(loaded)
        return loaded

    def _described(
        self,
        kind: kinds.Kind,
        processors: Processors,
        trained: DatasetContract,
        renames: dict[str, str],
    ) -> LoadedLeRobot:
        """Return the loaded checkpoint with the contract that follows from its training."""
        settings = kind.config
        cameras = _cameras(settings, self.config, renames, trained.cameras)
        parts = (
            list(self.config.state or trained.state or [JOINTS])
            if settings.robot_state_feature
            else []
        )
        inputs = [
            *cameras,
            *(key for key in (STATE, ENVIRONMENT) if key in settings.input_features),
        ]
        processors.require_statistics(settings, inputs)
        environment = (
            list(trained.environment or [ENVIRONMENT_STATE]) if settings.env_state_feature else []
        )
        width = processors.width(kind.dim)
        action, known = trained.contract.action, trained.contract.state or {}
        action = action if action.dim == width else ActionSpec(dim=width)
        if len(names := getattr(settings, "action_feature_names", None) or ()) == width:
            action = replace(action, names=tuple(names))
        state = (
            model_inputs.state_specs(parts, settings.robot_state_feature.shape[0]) if parts else {}
        )
        if tuple(parts) == trained.state:
            state |= known
        around = (
            model_inputs.state_specs(environment, settings.env_state_feature.shape[0])
            if environment
            else {}
        )
        contract = Contract(
            cameras={ours: _camera(settings, key) for key, ours in cameras.items()},
            state=state | {part: known.get(part, spec) for part, spec in around.items()},
            gripper=model_inputs.needs_gripper(parts),
            instruction=processors.instructed or None,
            action=action,
            control_hz=trained.contract.control_hz,
            chunk=self.chunk(kind.horizon),
            history=kind.steps,
            behaviour=self.offered(OFFERED if self.config.noise_level else ()),
        )
        return LoadedLeRobot(
            kind, processors, cameras, parts, environment, contract, trained, renames
        )

    def adapt(self, adapter: str, folder: Path) -> None:
        """Keep the processors saved with an adapter, if any, for the state and the actions of its
        rows.

        A base that does not describe its dataset, such as one of many robots, gets the contract of
        the adapter's dataset.
        """
        model: LoadedLeRobot = self.model
        own = adapter_processors(folder, model.kind.config, self.config, model.processors)
        if own is None:
            return
        stated, renames = own.dataset(), model.renames or own.rename_map
        trained = model.trained if stated is None else _trained(model.kind.config, own)
        unsaid = model.trained.contract == Contract() and model.trained.state in ((), trained.state)
        if own.rename_map not in ({}, renames) or not (unsaid or stated in (None, model.trained)):
            raise ConfigError(
                f"{folder}: its dataset has another contract, or its cameras other names, than "
                "that of the base or of an adapter before, want the same; serve it in a deployment "
                "of its own"
            )
        if trained != model.trained:
            self.model = model = replace(
                self._described(model.kind, model.processors, trained, renames), own=model.own
            )
        model.own[adapter] = own

    def perceive(self, obs: Obs) -> StagedRow:
        model: LoadedLeRobot = self.model
        frame = {
            key: image.copy()
            for key, image in model_inputs.camera_images(obs, model.cameras).items()
        }
        if model.state:
            frame[STATE] = model.trained.wrapped(
                model_inputs.state_vector(obs, model.state, self.state_dim)
            )
        if model.environment:
            width = int(model.kind.config.env_state_feature.shape[0])
            frame[ENVIRONMENT] = model_inputs.state_vector(obs, model.environment, width)
        return model.kind.staging.stage(frame)

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        if not self.model.kind.batched:  # an error fails only its session
            return [attempt(lambda row: self._draw([row])[0], row) for row in rows]
        groups: dict[Any, list[int]] = {}
        for i, row in enumerate(rows):
            groups.setdefault(tuple(array.shape for array in row.frames[-1].values()), []).append(i)
        drawn: dict[int, Prediction | Exception] = {}
        for members in groups.values():
            drawn |= zip(members, self._draw([rows[i] for i in members]), strict=True)
        return [drawn[i] for i in range(len(rows))]

    def _draw(self, rows: list[Row]) -> list[Prediction]:
        torch, model = require("torch"), self.model
        kind, settings = model.kind, model.kind.config
        leftovers = [model.own.get(row.adapter, model.processors).leftover(row) for row in rows]
        # As in LeRobot's own loop.
        mixed = settings.use_amp and torch.device(settings.device).type == "cuda"
        with torch.inference_mode(), torch.autocast("cuda", enabled=mixed):
            seen = [rows[i] for i in kind.observations(rows)]
            inputs = model.processors.observe(seen, kind.steps)
            for adapter, own in model.own.items():
                if STATE in inputs and (places := _of(adapter, seen)):
                    inputs[STATE][places] = own.normalised_state([seen[i] for i in places])
            drawn = kind.draw(inputs, rows, leftovers)
            chunks = np.array(model.processors.actions(drawn))
            for adapter, own in model.own.items():
                if places := _of(adapter, rows):
                    chunks[places] = own.actions(drawn[places])
            dim = settings.action_feature.shape[0]
            outputs = {} if kind.random is None else kind.random.outputs(self.config.execute, dim)
        given = [{GIVEN: kind.given[i]} if i in kind.given else {} for i in range(len(rows))]
        return [
            Prediction(chunk, behaviour=outputs.get(i, {}), info=given[i])
            for i, chunk in enumerate(chunks)
        ]


def _of(adapter: str, rows: Sequence[Row]) -> list[int]:
    return [i for i, row in enumerate(rows) if row.adapter == adapter]


def _with_defaults(config: LeRobotConfig, kind: kinds.Kind) -> LeRobotConfig:
    """Return the settings, with the checkpoint's values as defaults."""
    coefficient = getattr(kind.config, "temporal_ensemble_coeff", None)
    defaults: dict[str, Any] = {} if config.actions == "ensemble" else {"execute": kind.usual}
    if kind.steps > 1:  # trained on consecutive frames, so it also needs those within a chunk
        defaults["actions"] = "queue"
    if coefficient is not None:  # its n_action_steps is 1, since LeRobot then runs it at every tick
        defaults = {"actions": "ensemble", "ensemble_m": coefficient, "execute": None}
    if (config.execute or 0) > kind.horizon:
        raise ConfigError(
            f"execute: got {config.execute}, the checkpoint's chunks have {kind.horizon} rows from "
            "the observation on; want at most these"
        )
    return config.model_copy(
        update={k: v for k, v in defaults.items() if k not in config.model_fields_set}
    )


def _ranges(loaded: LoadedLeRobot) -> dict[str, Any] | None:
    """Return `Agent.statistics`: without turned angles of the state, and relative actions."""
    found: dict[str, Any] = {}
    for key, comparable in (
        (STATE, not loaded.trained.angles),
        (ACTION, not loaded.processors.whole),
    ):
        known = loaded.processors.statistics(key) if comparable else {}
        for names in (("min", "max"), ("q01", "q99")):
            if all(known.get(name) and np.isfinite(known[name]).all() for name in names):
                found.setdefault(key, {name: known[name] for name in names})
    return {"parts": loaded.state, **found} if found else None


def _trained(settings: Any, processors: Processors) -> DatasetContract:
    """Return the contract of the checkpoint's dataset, or one inferred from the features of a
    dataset without one.
    """
    state, dataset = settings.robot_state_feature, processors.dataset()
    if dataset is None:
        return (
            DatasetContract(Contract())
            if state is None
            else _of_features(settings.input_features, processors)
        )
    if state is None or dataset.width == state.shape[0]:
        return dataset
    log.warning(
        "the contract of the checkpoint's dataset has %d numbers of state, the policy takes %d: it "
        "is not used; set `state` to the parts that the policy was trained with",
        dataset.width,
        state.shape[0],
    )
    return DatasetContract(Contract())


def _of_features(features: Iterable[str], processors: Processors) -> DatasetContract:
    """Infer the parts of the state, and its angles, from features and their statistics.

    Copies that LeRobot's tools make without some episodes have no contract. The parts are the
    features other than `observation.state`; their order follows from comparing their statistics
    with those of `observation.state`.
    """
    keys = {key.removeprefix(f"{STATE}."): key for key in features if key.startswith(f"{STATE}.")}
    if f"observation.{model_inputs.GRIPPER}" in features:
        keys[model_inputs.GRIPPER] = f"observation.{model_inputs.GRIPPER}"
    whole = processors.statistics(STATE)
    parts = {part: processors.statistics(key) for part, key in keys.items()}
    listed = [part for key in features for part, own in keys.items() if own == key]

    def alike(name: str) -> bool:
        values, wanted = (
            np.concatenate([parts[part].get(name, []) for part in order]),
            whole.get(name, []),
        )
        return len(values) == len(wanted) and np.allclose(values, wanted, rtol=1e-5, atol=1e-6)

    for order in (listed, sorted(keys, key=lambda part: (part == model_inputs.GRIPPER, part))):
        if order and all(map(alike, _MATCHED)):
            break
    else:
        return DatasetContract(Contract())
    angles, place = {}, 0
    for part in order:
        width = len(parts[part]["mean"])
        for i in angles_in(part, usual_unit(part), width):
            centre = centre_between(whole["min"][place + i], whole["max"][place + i])
            if centre is not None:
                angles[place + i] = centre
        place += width
    return DatasetContract(Contract(), tuple(order), angles=angles)


def _cameras(
    settings: Any, config: LeRobotConfig, renames: dict[str, str], trained: Mapping[str, str]
) -> dict[str, str]:
    names = {key: _short(key) for key in settings.image_features if _EMPTY not in key}
    if unknown := sorted(set(config.masked_cameras) - set(names.values())):
        raise ConfigError(f"masked_cameras: got {unknown}, want some of {sorted(names.values())}")
    if config.masked_cameras and settings.type not in kinds.MASKING:
        raise ConfigError(
            f"masked_cameras: LeRobot's {settings.type!r} needs all its cameras, "
            f"{sorted(names.values())}; {sorted(kinds.MASKING)} can do without"
        )
    seen = {key: name for key, name in names.items() if name not in config.masked_cameras}
    sources = {renamed: source for source, renamed in renames.items()}
    features = {name: sources.get(key, key) for key, name in seen.items()}  # the dataset's names
    usual = {name: trained.get(feature, _short(feature)) for name, feature in features.items()}
    chosen = model_inputs.choose_cameras(config.cameras, usual, list(seen.values()))
    return {key: chosen[name] for key, name in seen.items()}


def _short(key: str) -> str:
    return key.removeprefix("observation.images.").removeprefix("observation.")


def _camera(settings: Any, key: str) -> CameraSpec:
    """Specify a camera: any size if the policy resizes, else that of its training."""
    if (
        settings.type in kinds.RESIZING
        or getattr(settings, "resize_imgs_with_padding", None) is not None
    ):
        return CameraSpec()
    _, height, width = settings.input_features[key].shape
    return CameraSpec(height, width)
