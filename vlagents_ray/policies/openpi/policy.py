"""The policy that runs openpi's models and transforms."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import Contract, StateSpec
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row, shared_frames
from vlagents_ray.policies.base.checkpoint import STEP, find_checkpoint
from vlagents_ray.policies.base.model_code import use_source
from vlagents_ray.policies.base.model_inputs import (
    CLOSED,
    GRIPPER,
    camera_specs,
    needs_gripper,
)
from vlagents_ray.policies.base.realtime import Guide
from vlagents_ray.policies.flow import OFFERED
from vlagents_ray.policies.openpi.models import OpenPiConfig, OpenPiModel, load_jax, load_torch
from vlagents_ray.policies.openpi.robots import RobotConvention, Transforms, choose_robot
from vlagents_ray.registry import require

_REMOTE = "://"


@dataclass(frozen=True)
class LoadedOpenPi:
    """A model with its transforms and the robot's convention."""

    model: OpenPiModel
    transforms: Transforms
    robot: RobotConvention
    horizon: int


@dataclass(frozen=True)
class SeenObs:
    """An observation in openpi's form, without the prompt, and the model's inputs of it."""

    raw: dict[str, Any]
    inputs: dict[str, Any]


@dataclass(frozen=True)
class TransformedRow:
    """A row in the form of the model's inputs."""

    inputs: dict[str, Any]
    row: Row  # with its leftover actions in the model's units
    noise: np.ndarray


class OpenPi(ModelPolicy):
    """The policies of openpi, with one call of the model for many sessions."""

    Config: ClassVar[type] = OpenPiConfig
    config: OpenPiConfig
    model: LoadedOpenPi | None

    @property
    def contract(self) -> Contract:
        """The contract of the robot that the checkpoint's config names; empty before the checkpoint is loaded."""
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
            behaviour=self.offered(OFFERED if self.config.noise_level else ()),
        )

    @property
    def continues_plans(self) -> bool:
        flows = self.model is not None and self.model.model.noise_shape is not None
        return flows and self.config.actions == "chunk"

    def load(self) -> LoadedOpenPi:
        """Load the checkpoint by the config with which it was trained."""
        use_source("openpi", SOURCE, self.config.source_dir, within=FOLDERS)
        config = train_config(self.config.config)
        folder = self._folder()
        transforms = Transforms.of(config, folder)
        ours = self.config
        robot = choose_robot(config.name, transforms.robot, ours.cameras, ours.state, ours.layout)
        if (folder / "model.safetensors").is_file():
            model = load_torch(config, folder, self.config, self.compilation)
        elif (folder / "params").is_dir():
            if self.config.compile:
                raise ConfigError("compile: openpi's JAX models always are; leave it out")
            self.config = self.config.with_sizes(self.report.batch_sizes)
            model = load_jax(config, folder, self.config)
        else:
            raise ConfigError(
                f"checkpoint {folder}: has {sorted(p.name for p in folder.iterdir())}, want params/ or "
                f"model.safetensors; name the folder of one step, not that of the run"
            )
        return LoadedOpenPi(model, transforms, robot, config.model.action_horizon)

    def perceive(self, obs: Obs) -> SeenObs:
        """Convert the observation to openpi's form, and by openpi's transforms to the model's inputs."""
        loaded = self._loaded()
        seen = loaded.robot.read(obs)
        return SeenObs(seen, loaded.transforms.read(seen, self._begun().instruction))

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """Compute the chunks of all rows that openpi's transforms accept, in one call of the model."""
        read = [self._planned(row) for row in rows]
        spare = next((one for one in read if not isinstance(one, Exception)), None)
        if spare is None:
            return read  # type: ignore[return-value]  # errors all
        # A valid row stands in for an invalid one, so that the number of rows remains a compiled one.
        spare = replace(spare, row=replace(spare.row, want=()))
        flows, stated = self._sample([spare if isinstance(one, Exception) else one for one in read])
        actions = self._loaded().transforms.actions
        return [
            one
            if isinstance(one, Exception)
            else Prediction(actions(one.inputs["state"], flow), behaviour=stated.get(i, {}))
            for i, (one, flow) in enumerate(zip(read, flows, strict=True))
        ]

    def _shared(self, rows: Sequence[Row]) -> tuple[list[int], list[int]]:
        """Return `shared_frames`, or each row by itself for a model whose rows cannot share an observation.

        The observations are padded to one of `batch_sizes`, as rows are.
        """
        each = list(range(len(rows)))
        firsts, owners = shared_frames(rows) if self._loaded().model.shares else (each, each)
        size = next((size for size in self.config.batch_sizes or () if size >= len(firsts)), len(firsts))
        return firsts + firsts[-1:] * (size - len(firsts)), owners

    def _planned(self, row: Row) -> TransformedRow | Exception:
        """Return the row with its leftover actions in the model's units, or an exception for its session."""
        loaded, seen = self._loaded(), row.frames[-1]
        try:
            if row.leftover is not None:
                row = replace(row, leftover=loaded.transforms.plan(seen.raw, row.instruction, row.leftover))
        except Exception as error:  # noqa: BLE001 - returned to the session of the observation
            return error
        return TransformedRow(seen.inputs, row, row.noise(*loaded.model.noise_shape or ()))

    def _sample(self, ready: Sequence[TransformedRow]) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
        """Return what the model computes for rows, and what is wanted of them, by their places."""
        model, rows = self._loaded().model, [one.row for one in ready]
        firsts, owners = self._shared(rows)
        batch = require("jax").tree.map(lambda *leaves: np.stack(leaves), *(ready[i].inputs for i in firsts))
        shape = model.noise_shape
        guide = None if shape is None else Guide.of(rows, *shape)
        random = model.random_steps(rows, self.config.noise_level)
        flows = model.sample(batch, np.stack([one.noise for one in ready]), guide, owners, random)
        dim = self._loaded().robot.action.dim
        return flows, {} if random is None else random.stated(self.config.execute, dim)

    def _folder(self) -> Path:
        name, step = self.config.checkpoint, self.config.checkpoint_step
        if _REMOTE not in name:
            return find_checkpoint(name, step, needs=["assets"])
        return find_checkpoint(str(require("openpi.shared.download").maybe_download(name.replace(STEP, str(step)))))

    def _loaded(self) -> LoadedOpenPi:
        if self.model is None:
            raise PolicyFailed("openpi: act before initialize; the checkpoint is not loaded")
        return self.model


SOURCE = "OPENPI_SRC"  # the variable that names a checkout; PyPI's "openpi" is another project
FOLDERS = ("src", "packages/openpi-client/src")


def train_config(name: str) -> Any:
    """Return openpi's `TrainConfig` of a name, or the one at "module:NAME"."""
    configs = require("openpi.training.config")
    module, colon, attribute = name.partition(":")
    if not colon:
        try:
            return configs.get_config(name)
        except ValueError as error:
            raise ConfigError(f"config {name!r}: not one of openpi's {sorted(configs._CONFIGS_DICT)}") from error
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except ModuleNotFoundError as error:
        raise ConfigError(f"config {name!r}: no module {error.name!r}; add its folder to PYTHONPATH") from error
    if not isinstance(found, configs.TrainConfig):
        raise ConfigError(f"config {name!r}: got {type(found).__name__}, want an openpi TrainConfig")
    return found
