"""LeRobot's policies, many sessions in one forward pass, with their own processors around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.accelerator import torch_device
from vlagents_ray.policies.base.observing import (
    camera_images,
    choose_cameras,
    needs_gripper,
    state_specs,
    state_vector,
)
from vlagents_ray.policies.lerobot import checkpoint
from vlagents_ray.policies.lerobot.config import LeRobotConfig
from vlagents_ray.policies.lerobot.kinds import KINDS, MASKING, RESIZING, Kind
from vlagents_ray.policies.lerobot.processors import Processors
from vlagents_ray.registry import require

STATE, ENVIRONMENT = "observation.state", "observation.environment_state"
JOINTS, ENVIRONMENT_STATE = "joints", "environment_state"  # parts of `Obs.state` that make these, unless said otherwise
_EMPTY = "empty_camera_"  # of a policy that was trained with cameras that are always masked


@dataclass(frozen=True, slots=True)
class Loaded:
    """A checkpoint, ready: what all sessions share."""

    kind: Kind
    processors: Processors
    cameras: dict[str, str]  # the policy's observation key -> our name
    state: list[str]  # parts of the proprioception; none if the policy takes no state
    environment: int  # numbers of the environment's state; 0 if the policy takes none
    contract: Contract


class LeRobot(ModelPolicy):
    """Any policy that LeRobot 0.4.4 loads, by the `type` in its checkpoint."""

    Config: ClassVar[type] = LeRobotConfig
    config: LeRobotConfig

    @property
    def contract(self) -> Contract | None:
        """The checkpoint's; None before it is loaded."""
        return None if self.model is None else self.model.contract

    @property
    def history(self) -> int:
        return 1 if self.model is None else self.model.kind.steps

    @property
    def state_dim(self) -> int | None:
        feature = None if self.model is None else self.model.kind.config.robot_state_feature
        return None if feature is None else int(feature.shape[0])

    def load(self) -> Loaded:
        """Read the checkpoint. Raises `ConfigError` where anything of it is missing, unknown or random."""
        folder = checkpoint.find(self.config)
        policy = checkpoint.load(folder, self.config, torch_device(self.config.device))
        settings = policy.config
        kind = KINDS.get(settings.type, Kind)(policy)
        self.config = _with_defaults(self.config, kind)
        processors = Processors(folder, settings, self.config)
        cameras = _cameras(settings, self.config, processors.rename_map)
        parts = list(self.config.state or [JOINTS]) if settings.robot_state_feature else []
        inputs = [*cameras, *(key for key in (STATE, ENVIRONMENT) if key in settings.input_features)]
        processors.require_statistics(settings, inputs)
        environment = settings.env_state_feature.shape[0] if settings.env_state_feature else 0
        contract = Contract(
            cameras={ours: _camera(settings, key) for key, ours in cameras.items()},
            state=_states(parts, settings.robot_state_feature, environment),
            gripper=needs_gripper(parts),
            instruction=processors.instructed or None,
            action=ActionSpec(dim=processors.width(settings.action_feature.shape[0])),
            chunk=self.chunk(kind.horizon),
            history=kind.steps,
        )
        return Loaded(kind, processors, cameras, parts, environment, contract)

    def perceive(self, obs: Obs) -> dict[str, np.ndarray]:
        """Images by the policy's keys, (H, W, 3) uint8, and its state vectors, float32."""
        model: Loaded = self.model
        frame = {key: image.copy() for key, image in camera_images(obs, model.cameras).items()}
        if model.state:
            frame[STATE] = state_vector(obs, model.state, self.state_dim)
        if model.environment:
            frame[ENVIRONMENT] = state_vector(obs, [ENVIRONMENT_STATE], model.environment)
        return frame

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """One forward pass for all rows whose images are of one size; types that cannot batch run row by row."""
        chunks: dict[int, np.ndarray] = {}
        for members in self._groups(rows):
            chunks |= zip(members, self._draw([rows[i] for i in members]), strict=True)
        return [Prediction(chunks[i]) for i in range(len(rows))]

    def _groups(self, rows: Sequence[Row]) -> list[list[int]]:
        if not self.model.kind.batched:
            return [[i] for i in range(len(rows))]
        groups: dict[Any, list[int]] = {}
        for i, row in enumerate(rows):
            groups.setdefault(tuple(array.shape for array in row.frames[-1].values()), []).append(i)
        return list(groups.values())

    def _draw(self, rows: list[Row]) -> np.ndarray:
        """The rows' chunks, (B, horizon, D) float32."""
        torch, model = require("torch"), self.model
        settings = model.kind.config
        leftovers = [None if row.leftover is None else model.processors.leftover(row.leftover) for row in rows]
        device = torch.device(settings.device).type
        with torch.inference_mode(), torch.autocast(device, enabled=settings.use_amp):
            chunks = model.kind.draw(model.processors.observe(rows, model.kind.steps), rows, leftovers)
            return np.asarray(model.processors.actions(chunks))


def _with_defaults(config: LeRobotConfig, kind: Kind) -> LeRobotConfig:
    """The settings, where they are silent as the checkpoint was made to be run."""
    coefficient = getattr(kind.config, "temporal_ensemble_coeff", None)
    defaults: dict[str, Any] = {} if config.actions == "ensemble" else {"execute": kind.usual}
    if kind.steps > 1:  # trained on consecutive frames, so that it has to see those within a chunk, too
        defaults["actions"] = "queue"
    if coefficient is not None:  # its n_action_steps is 1, since LeRobot then asks at every tick
        defaults = {"actions": "ensemble", "ensemble_m": coefficient, "execute": None}
    if (config.execute or 0) > kind.horizon:
        raise ConfigError(
            f"execute: got {config.execute}, the checkpoint's chunks have {kind.horizon} rows from the observation on; "
            f"want at most these"
        )
    return config.model_copy(update={k: v for k, v in defaults.items() if k not in config.model_fields_set})


def _cameras(settings: Any, config: LeRobotConfig, renames: dict[str, str]) -> dict[str, str]:
    """The policy's observation key of each camera -> our name."""
    names = {key: _short(key) for key in settings.image_features if _EMPTY not in key}
    if unknown := sorted(set(config.masked_cameras) - set(names.values())):
        raise ConfigError(f"masked_cameras: got {unknown}, want some of {sorted(names.values())}")
    if config.masked_cameras and settings.type not in MASKING:
        raise ConfigError(
            f"masked_cameras: LeRobot's {settings.type!r} needs all its cameras, {sorted(names.values())}; "
            f"{sorted(MASKING)} can do without"
        )
    seen = {key: name for key, name in names.items() if name not in config.masked_cameras}
    sources = {renamed: source for source, renamed in renames.items()}
    usual = {name: _short(sources.get(key, key)) for key, name in seen.items()}
    chosen = choose_cameras(config.cameras, usual, list(seen.values()))
    return {key: chosen[name] for key, name in seen.items()}


def _short(key: str) -> str:
    return key.removeprefix("observation.images.").removeprefix("observation.")


def _camera(settings: Any, key: str) -> CameraSpec:
    """Any size where the policy resizes; elsewhere that of its training, as another one would change what it sees."""
    if settings.type in RESIZING or getattr(settings, "resize_imgs_with_padding", None) is not None:
        return CameraSpec()
    _, height, width = settings.input_features[key].shape
    return CameraSpec(height, width)


def _states(parts: Sequence[str], feature: Any, environment: int) -> dict[str, StateSpec]:
    specs = state_specs(parts, feature.shape[0]) if parts else {}
    return {**specs, ENVIRONMENT_STATE: StateSpec(environment)} if environment else specs
