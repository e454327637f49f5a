"""openpi's transforms from a robot's keys to a model's inputs, and from its outputs to the robot's actions."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.registry import require


@dataclass(frozen=True)
class Transforms:
    """The transforms of a checkpoint with its statistics, in the order of openpi's `create_trained_policy`."""

    inputs: Any  # a dict of unbatched arrays -> such a dict
    outputs: Any
    forward: Any  # the part of `inputs` for actions, before the model's own transforms
    robot: str  # the class of its first transform of observations, e.g. "LiberoInputs"
    prompt: bool  # whether one is needed; otherwise the config has its own

    @classmethod
    def of(cls, config: Any, folder: Path) -> Transforms:
        """Read the transforms; raises `ConfigError` if the checkpoint lacks statistics of the config's asset."""
        openpi = require("openpi.transforms")
        data = _data_config(config, folder)
        statistics = _statistics(folder, data.asset_id)
        quantiles = data.use_quantile_norm
        try:
            normalise = openpi.Normalize(statistics, use_quantiles=quantiles)
            restore = openpi.Unnormalize(statistics, use_quantiles=quantiles)
        except ValueError as error:
            raise ConfigError(f"checkpoint {folder}: {error}; compute its statistics with openpi's script") from error
        robot, model = data.data_transforms, data.model_transforms
        return cls(
            openpi.compose([*robot.inputs, normalise, *model.inputs]),
            openpi.compose([*model.outputs, restore, *robot.outputs]),
            openpi.compose([*robot.inputs, normalise]),
            type(robot.inputs[0]).__name__ if robot.inputs else "",
            not any(
                getattr(one, "prompt", None) for one in model.inputs if isinstance(one, openpi.InjectDefaultPrompt)
            ),
        )

    def read(self, observation: dict[str, Any], instruction: str) -> dict[str, Any]:
        """Return the model's inputs for one row."""
        inputs: dict[str, Any] = self.inputs(_with(observation, instruction))
        mask = np.asarray(inputs["tokenized_prompt_mask"])
        if mask.all():
            raise InvalidObservation(
                f"instruction: it fills all {mask.size} tokens of the model, so that its end may be cut off; shorten it"
            )
        return inputs

    def actions(self, state: np.ndarray, output: np.ndarray) -> np.ndarray:
        """Convert the model's output for one row to actions (H, D) float32, in the robot's units."""
        return np.asarray(self.outputs({"state": state, "actions": output})["actions"], np.float32)

    def plan(self, observation: dict[str, Any], instruction: str, actions: np.ndarray) -> np.ndarray:
        """Convert a robot's actions (H, D) to the model's units, relative to the observation if it is trained so."""
        data = _with(observation, instruction) | {"actions": np.array(actions)}
        return np.asarray(self.forward(data)["actions"], np.float32)


def _with(observation: dict[str, Any], instruction: str) -> dict[str, Any]:
    """Copy an observation as deeply as openpi's transforms change it."""
    data: dict[str, Any] = require("jax").tree.map(np.array, observation)
    return data | {"prompt": instruction} if instruction else data


def _data_config(config: Any, folder: Path) -> Any:
    """Return the config's data config with the checkpoint's statistics; openpi would first look for others online."""
    factory = config.data
    here = dataclasses.replace(factory.assets, assets_dir=str(folder / "assets"))
    return dataclasses.replace(factory, assets=here).create(config.assets_dirs, config.model)


def _statistics(folder: Path, asset: str | None) -> Any:
    if asset is None:
        raise ConfigError("config: has no asset_id, so that nothing says which statistics are its own; set one")
    try:
        found = require("openpi.shared.normalize").load(folder / "assets" / asset)
    except FileNotFoundError as error:
        have = sorted(str(p.parent.relative_to(folder / "assets")) for p in folder.glob("assets/**/norm_stats.json"))
        raise ConfigError(
            f"checkpoint {folder}: no assets/{asset}/norm_stats.json, has those of {have}; without statistics a "
            f"policy's actions have no units: copy them there, or choose the config of its training"
        ) from error
    absent = sorted({"state", "actions"} - set(found))
    if absent:
        raise ConfigError(f"checkpoint {folder}: assets/{asset}/norm_stats.json has no {absent}, has {sorted(found)}")
    return found
