"""The robots for which openpi has transforms: openpi's keys and our names of their cameras and states."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vlagents_ray.contract import ActionSpec
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base.model_inputs import camera_images, choose_cameras, state_vector
from vlagents_ray.registry import require

Layout = Literal["hwc", "chw"]


@dataclass(frozen=True, slots=True)
class RobotConvention:
    """The mapping of an `Obs` to the inputs of openpi's transforms for a robot."""

    cameras: Mapping[str, str]  # openpi's key -> our camera
    state: Mapping[str, Mapping[str, int]]  # openpi's key -> parts of our state and their lengths
    layout: Layout = "hwc"
    action: ActionSpec = field(default_factory=ActionSpec)
    optional: tuple[str, ...] = ()  # cameras that openpi masks if they are missing

    def read(self, obs: Obs) -> dict[str, Any]:
        """Return openpi's observation without the prompt: copies of the images, uint8, and states, float32."""
        data: dict[str, Any] = {}
        for key, image in camera_images(obs, self.cameras).items():
            _put(data, key, np.array(image if self.layout == "hwc" else image.transpose(2, 0, 1)))
        for key, parts in self.state.items():
            _put(data, key, state_vector(obs, list(parts), sum(parts.values())))
        return data


def _put(data: dict[str, Any], key: str, value: np.ndarray) -> None:
    *above, last = key.split(".")
    for name in above:
        data = data.setdefault(name, {})
    data[last] = value


_ALOHA = RobotConvention(
    {"images.cam_high": "front", "images.cam_left_wrist": "left_wrist", "images.cam_right_wrist": "right_wrist"},
    {"state": {"left/joints": 6, "left/gripper": 1, "right/joints": 6, "right/gripper": 1}},
    "chw",
    ActionSpec(dim=14, arms=("left", "right")),
    optional=("images.cam_left_wrist", "images.cam_right_wrist"),
)

# As in openpi's examples/{libero,droid,aloha_real,aloha_sim}. In LIBERO's actions a gripper closes at 1, in DROID's too
# (and its reading is 0 when open); ALOHA's two are in [0, 1], at 6 and 13, 1 = open, and pass as they are.
ROBOTS: Mapping[str, RobotConvention] = {  # by the class of openpi's transform of observations
    "LiberoInputs": RobotConvention(
        {"observation/image": "front", "observation/wrist_image": "wrist"},
        {"observation/state": {"xyz_axis_angle": 6, "gripper_qpos": 2}},
        action=ActionSpec(dim=7, delta=True, gripper_open=-1.0, gripper_closed=1.0),
    ),
    "DroidInputs": RobotConvention(
        {"observation/exterior_image_1_left": "front", "observation/wrist_image_left": "wrist"},
        {"observation/joint_position": {"joints": 7}, "observation/gripper_position": {"gripper_closed": 1}},
        action=ActionSpec(dim=8, gripper_open=0.0, gripper_closed=1.0),
    ),
    "AlohaInputs": _ALOHA,
}
_ALOHA_SIM = {"images.cam_high": "front"}  # the simulation has one camera


def choose_robot(
    config: str,
    transform: str,
    cameras: Mapping[str, str] | None,
    state: Mapping[str, Mapping[str, int]] | None,
    layout: Layout | None,
) -> RobotConvention:
    """Return the convention of the robot of one of openpi's configs, with the settings that override it.

    Raises:
        ConfigError: The config's transform is not one of openpi's own, and `cameras` and `state` are not both set.
    """
    usual = ROBOTS.get(transform)
    if usual is None:
        if cameras is None or state is None:
            raise ConfigError(
                f"config {config!r}: its observations go through {transform or 'no transform'}, want one of "
                f"{sorted(ROBOTS)}, or its keys, as in cameras: {{KEY: front}}, state: {{KEY: {{joints: 7}}}}"
            )
        usual = RobotConvention(cameras, {})
    if cameras is None and config == "pi0_aloha_sim":
        cameras = _ALOHA_SIM
    known = [key for key in usual.cameras if key not in usual.optional or cameras is None or key in cameras]
    return replace(
        usual,
        cameras=choose_cameras(cameras, usual.cameras, known),
        state=usual.state if state is None else state,
        layout=layout or usual.layout,
    )


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
