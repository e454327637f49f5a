"""The robots for which openpi has transforms: openpi's keys and our names of their cameras and states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from vlagents_ray.contract import ActionSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base.model_inputs import camera_images, choose_cameras, state_vector

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
