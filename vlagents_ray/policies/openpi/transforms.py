"""openpi's own transforms around its models: from a robot's keys to a model's inputs, and back to its actions."""

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
    """Those of one checkpoint, with its statistics, in the order of openpi's `create_trained_policy`."""

    inputs: Any  # a dict of unbatched arrays -> such a dict
    outputs: Any
    forward: Any  # what `inputs` does to actions before the model's own transforms
    robot: str  # the class of its first transform of observations, e.g. "LiberoInputs"
    prompt: bool  # is one needed, or has the config its own?

    @classmethod
    def of(cls, config: Any, folder: Path) -> Transforms:
        """`ConfigError` where the checkpoint has no statistics of the config's asset, or too few."""
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
        """The model's inputs for one row."""
        inputs: dict[str, Any] = self.inputs(_with(observation, instruction))
        mask = np.asarray(inputs["tokenized_prompt_mask"])
        if mask.all():
            raise InvalidObservation(
                f"instruction: it fills all {mask.size} tokens of the model, so that its end may be cut off; shorten it"
            )
        return inputs

    def actions(self, state: np.ndarray, said: np.ndarray) -> np.ndarray:
        """What the model said for one row -> (H, D) float32, in the robot's units."""
        return np.asarray(self.outputs({"state": state, "actions": said})["actions"], np.float32)

    def plan(self, observation: dict[str, Any], instruction: str, actions: np.ndarray) -> np.ndarray:
        """A robot's actions (H, D) as the model sees them, relative to that observation where it is trained so."""
        data = _with(observation, instruction) | {"actions": np.array(actions)}
        return np.asarray(self.forward(data)["actions"], np.float32)


def _with(observation: dict[str, Any], instruction: str) -> dict[str, Any]:
    """A copy, as deep as openpi's transforms change theirs."""
    data: dict[str, Any] = require("jax").tree.map(np.array, observation)
    return data | {"prompt": instruction} if instruction else data


def _data_config(config: Any, folder: Path) -> Any:
    """The config's, with the checkpoint's own statistics: openpi would look for others first, on the network too."""
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
            f"checkpoint {folder}: no assets/{asset}/norm_stats.json, has those of {have}; without its statistics a "
            f"policy's actions mean nothing: copy them there, or choose the config that it was trained with"
        ) from error
    absent = sorted({"state", "actions"} - set(found))
    if absent:
        raise ConfigError(f"checkpoint {folder}: assets/{asset}/norm_stats.json has no {absent}, has {sorted(found)}")
    return found
