"""The policy around openpi's models and transforms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import Contract, StateSpec
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.checkpoint import STEP, find_checkpoint
from vlagents_ray.policies.base.observing import CLOSED, GRIPPER, camera_specs, needs_gripper
from vlagents_ray.policies.base.realtime import Guide
from vlagents_ray.policies.base.source import use_source
from vlagents_ray.policies.openpi.config import OpenPiConfig
from vlagents_ray.policies.openpi.models import Model, load_jax, load_torch
from vlagents_ray.policies.openpi.robots import Robot, choose_robot
from vlagents_ray.policies.openpi.training import FOLDERS, SOURCE, train_config
from vlagents_ray.policies.openpi.transforms import Transforms
from vlagents_ray.registry import require

_JAX_SIZES = [1, 2, 4, 8, 16]
_REMOTE = "://"


@dataclass(frozen=True)
class Loaded:
    """The model, and what is around it."""

    model: Model
    transforms: Transforms
    robot: Robot
    horizon: int


@dataclass(frozen=True)
class Ready:
    """A row as the model takes it."""

    inputs: dict[str, Any]
    row: Row  # its leftover actions as the model sees them
    noise: np.ndarray


class OpenPi(ModelPolicy):
    """openpi's policies, many sessions in one call of the model."""

    Config: ClassVar[type] = OpenPiConfig
    config: OpenPiConfig
    model: Loaded | None

    @property
    def contract(self) -> Contract:
        """Known once the checkpoint is loaded: its config says whose robot it is for."""
        if self.model is None:
            return Contract()
        robot = self.model.robot
        parts = {part: dim for vector in robot.state.values() for part, dim in vector.items()}
        return Contract(
            cameras=camera_specs(robot.cameras),
            state={part: StateSpec(dim) for part, dim in parts.items() if part not in (GRIPPER, CLOSED)},
            gripper=needs_gripper(list(parts)),
            instruction=self.model.transforms.prompt,
            action=robot.action,
            chunk=self.chunk(self.model.horizon),
            history=1,
        )

    def load(self) -> Loaded:
        """The checkpoint, by the config that it was trained with."""
        use_source("openpi", SOURCE, self.config.source_dir, within=FOLDERS)
        config = train_config(self.config.config)
        folder = self._folder()
        transforms = Transforms.of(config, folder)
        ours = self.config
        robot = choose_robot(config.name, transforms.robot, ours.cameras, ours.state, ours.layout)
        if (folder / "model.safetensors").is_file():
            model = load_torch(config, folder, self.config)
        elif (folder / "params").is_dir():
            if self.config.compile:
                raise ConfigError("compile: openpi's JAX models always are; leave it out")
            if self.config.batch_sizes is None:
                self.config = self.config.model_copy(update={"batch_sizes": _JAX_SIZES})
            model = load_jax(config, folder, self.config)
        else:
            raise ConfigError(
                f"checkpoint {folder}: has {sorted(p.name for p in folder.iterdir())}, want params/ or "
                f"model.safetensors; name the folder of one step, not that of the run"
            )
        return Loaded(model, transforms, robot, config.model.action_horizon)

    def perceive(self, obs: Obs) -> dict[str, Any]:
        """openpi's observation, but for the prompt."""
        return self._loaded().robot.read(obs)

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """One call of the model for all rows that openpi's transforms take."""
        read = [self._read(row) for row in rows]
        spare = next((one for one in read if not isinstance(one, Exception)), None)
        if spare is None:
            return read  # type: ignore[return-value]  # errors all
        # The number of rows stays one that is compiled: in the place of a bad one goes a good one.
        said = self._sample([spare if isinstance(one, Exception) else one for one in read])
        actions = self._loaded().transforms.actions
        return [
            one if isinstance(one, Exception) else Prediction(actions(one.inputs["state"], flow))
            for one, flow in zip(read, said, strict=True)
        ]

    def _read(self, row: Row) -> Ready | Exception:
        """A row as the model takes it, or what is wrong with it, which its own session is told."""
        loaded, observation = self._loaded(), row.frames[-1]
        shape = loaded.model.noise_shape
        try:
            inputs = loaded.transforms.read(observation, row.instruction)
            if row.leftover is not None:
                row = replace(row, leftover=loaded.transforms.plan(observation, row.instruction, row.leftover))
        except Exception as error:  # noqa: BLE001 - handed to the session whose observation it is
            return error
        return Ready(inputs, row, row.noise(*shape or ()))

    def _sample(self, ready: Sequence[Ready]) -> np.ndarray:
        model = self._loaded().model
        batch = require("jax").tree.map(lambda *leaves: np.stack(leaves), *(one.inputs for one in ready))
        shape = model.noise_shape
        guide = None if shape is None else Guide.of([one.row for one in ready], *shape)
        return model.sample(batch, np.stack([one.noise for one in ready]), guide)

    def _folder(self) -> Path:
        name, step = self.config.checkpoint, self.config.checkpoint_step
        if _REMOTE not in name:
            return find_checkpoint(name, step, needs=["assets"])
        return Path(require("openpi.shared.download").maybe_download(name.replace(STEP, str(step))))

    def _loaded(self) -> Loaded:
        if self.model is None:
            raise PolicyFailed("openpi: act before initialize; the checkpoint is not loaded")
        return self.model
