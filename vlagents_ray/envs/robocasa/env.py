"""A kitchen task of RoboCasa365 as an environment for evaluations."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract
from vlagents_ray.envs.base import require_known
from vlagents_ray.envs.rendering.render_probe import failing, without, without_egl
from vlagents_ray.envs.robocasa.assets import REGISTRIES, require_assets
from vlagents_ray.envs.robocasa.tasks import (
    ACTION_ORDERS,
    CAMERAS,
    HORIZONS,
    SIZE,
    SPLITS,
    ActionOrder,
    Split,
    contract,
    protocol,
)
from vlagents_ray.envs.robosuite.base import RobosuiteEnv
from vlagents_ray.envs.robosuite.importing import importing_robosuite
from vlagents_ray.envs.robosuite.simulation import seeded
from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.interface import Obs
from vlagents_ray.registry import require

_CURE = (
    "run `vlagents-ray env make requirements/robocasa.txt` and give the evaluation's workers that environment's Python"
)
# robosuite's hand, gripper, base, torso and mode, in the datasets' order
_FROM_BASE_FIRST = [*range(5, 12), *range(5)]
_GRIPPER, _MODE = 6, 11  # in robosuite's order
_ON = 0.5  # the threshold of RoboCasa's own Gymnasium environments, so that -1 and 1 serve as well as 0 and 1


class RoboCasa(RobosuiteEnv):
    """One environment of one of RoboCasa365's tasks, e.g. "OpenDrawer": a Panda arm on an Omron base, in a kitchen.

    Observation: cameras by RoboCasa's names, upright; in `state`, by the names of its datasets, `base_position` (3,) m
    and `base_rotation` (4,) xyzw in the world's frame, `end_effector_position_relative` (3,) m and
    `end_effector_rotation_relative` (4,) xyzw of the hand in the base's frame, `gripper_qpos` (2,) m of the fingers.

    Action: (12,) in [-1, 1]: the base's velocity forward and to the left (1 m/s a unit) and about its axis (1.5 rad/s a
    unit), the torso's height; the mode, at least 0.5 where the base moves and the hand shall move with it; the hand's
    target, which moves by 0.05 m a unit along the base's axes, and turns by 0.5 rad a unit about them, axis-angle; the
    gripper, which closes at 0.5 or more, and opens below that.
    """

    _raw: Mapping[str, str] = {
        "base_position": "robot0_base_pos",
        "base_rotation": "robot0_base_quat",
        "end_effector_position_relative": "robot0_base_to_eef_pos",
        "end_effector_rotation_relative": "robot0_base_to_eef_quat",
        "gripper_qpos": "robot0_gripper_qpos",
    }

    def __init__(
        self,
        task: str = "OpenDrawer",
        *,
        split: Split = "target",
        width: int | None = None,
        height: int | None = None,
        cameras: Sequence[str] | None = None,
        action_order: ActionOrder = "base_first",
        object_registries: Sequence[str] = REGISTRIES,
        max_steps: int | None = None,
        ends_on_success: bool = True,
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Make the environment.

        Args:
            task: RoboCasa's name, one of `tasks()`.
            split: The kitchens and objects: "target" or "pretrain".
            width: Width of each image, pixels; None is the protocol's.
            height: Height of each image, pixels; None is the protocol's.
            cameras: RoboCasa's names; None are the protocol's three.
            action_order: "base_first", the order of an action in RoboCasa365's datasets, or "arm_first": hand,
                gripper, base, torso, mode, as RoboCasa's `convert_action` and LeRobot's environment have it.
            object_registries: The sets of objects that are drawn from; the protocol has both.
            max_steps: The step limit; None is the protocol's for the task.
            ends_on_success: As in the protocol; False: success at the end can be measured, too.
            record_size: Height and width of further views by the same cameras, for recordings only.

        Raises:
            UnknownEnv: There is no such task.
            ConfigError: An option has a wrong value.
            MissingDependency: The simulator is not installed.
            EnvFailed: The simulator cannot be loaded, or its assets are not there.
        """
        self.require_task(task)
        name = f"robocasa/{task}"
        for option, chosen, known in (
            ("split", [split], SPLITS),
            ("action_order", [action_order], ACTION_ORDERS),
            ("object_registries", object_registries, REGISTRIES),
        ):
            if not chosen or not set(chosen) <= set(known):
                raise ConfigError(f"{name}: {option} has {list(chosen)}, want some of {list(known)}")
        super().__init__(
            name,
            protocol=protocol(task, split),
            width=width,
            height=height,
            max_steps=max_steps,
            ends_on_success=ends_on_success,
            record_size=record_size,
        )
        self._contract = self.known_contract(
            {"width": width, "height": height, "cameras": cameras, "action_order": action_order}
        )
        self._order = _FROM_BASE_FIRST if action_order == "base_first" else list(range(12))
        self._registries = tuple(object_registries)
        self._instruction = ""
        images = self._contract.cameras or {}
        simulator = self._load()
        with failing(self._name, "make"), seeded(0):
            made = simulator.utils.env_utils.create_env(
                task,
                split=split,
                obj_registries=self._registries,
                camera_names=list(images),
                camera_heights=height or SIZE,
                camera_widths=width or SIZE,
                renderer="mujoco",  # as in envs/robosuite
            )
            made.use_camera_obs = made.has_offscreen_renderer = bool(images)  # before the first reset, which loads it
        self._versions = {"robocasa": simulator.__version__, "robosuite": simulator.robosuite.__version__}
        self._use(made)

    def _load(self) -> Any:
        require_assets(self._registries)
        with (
            failing(self._name, "import robocasa"),
            importing_robosuite("robocasa"),
            contextlib.redirect_stdout(io.StringIO()),  # advice about packages that are not needed
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")  # warnings of upstream code
            return require("robocasa")

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        chosen = CAMERAS if arguments["cameras"] is None else arguments["cameras"]
        size = CameraSpec(arguments["height"] or SIZE, arguments["width"] or SIZE)
        return contract(dict.fromkeys(chosen, size), arguments["action_order"])

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        """The task in words, which names this kitchen's things; empty before the first reset."""
        return self._instruction

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin the episode of `seed`, taken modulo 2^32, in the kitchen that it draws; there are no options."""
        obs, info = super().reset(seed=seed, options=options)
        facts = self._alive().get_ep_meta()
        self._instruction = str(facts["lang"])
        return obs, info | {"layout": int(facts["layout_id"]), "style": int(facts["style_id"])}

    @classmethod
    def require_task(cls, task: str | None) -> None:
        require_known("robocasa", task or "OpenDrawer", cls.tasks())

    @classmethod
    def tasks(cls) -> list[str]:
        return list(HORIZONS)

    @classmethod
    def missing(cls) -> str | None:
        """Say why RoboCasa cannot run here; the first call in a process renders one frame in a child."""
        if missing := without(("robocasa", "robosuite", "mujoco"), _CURE):
            return missing
        try:
            require_assets()
        except EnvFailed as error:
            return str(error)
        return without_egl("RoboCasa")

    def describe(self) -> dict[str, Any]:
        played = self._protocol.describe(max_steps=self.max_steps, ends_on_success=self._ends_on_success)
        if set(self._registries) != set(REGISTRIES):
            played["deviations"].append(
                f"object_registries: {list(self._registries)}, the protocol says {list(REGISTRIES)}"
            )
        return super().describe() | self._versions | {"protocol": played}

    def _command(self, action: np.ndarray) -> np.ndarray:
        command = action[self._order]
        for switch in (_GRIPPER, _MODE):
            command[switch] = 1.0 if command[switch] >= _ON else -1.0
        return command
