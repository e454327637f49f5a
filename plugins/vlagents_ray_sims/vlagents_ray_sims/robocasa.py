"""The fifty kitchen tasks of RoboCasa365's evaluation: a Panda arm on a mobile base, in MuJoCo."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import DELTA_POSE
from vlagents_ray.envs.simulator import BenchmarkProtocol, failing
from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.interface import Obs
from vlagents_ray.registry import require
from vlagents_ray_sims.robosuite import RobosuiteEnv, importing_robosuite, seeded

CONTROL_HZ = 20.0
SIZE = 256  # px, of each image, as in the datasets and in RoboCasa's own Gymnasium environments
CAMERAS = ("robot0_agentview_left", "robot0_agentview_right", "robot0_eye_in_hand")

Split = Literal["target", "pretrain"]
ActionOrder = Literal["base_first", "arm_first"]

# RoboCasa's three sets of tasks with their horizons in steps, from dataset_registry.py of version
# 1.0.1. These horizons are 1.5 times as long as in 1.0.0.
ATOMIC_SEEN: Mapping[str, int] = {
    "CloseBlenderLid": 900,
    "CloseFridge": 900,
    "CloseToasterOvenDoor": 450,
    "CoffeeSetupMug": 600,
    "NavigateKitchen": 450,
    "OpenCabinet": 1050,
    "OpenDrawer": 750,
    "OpenStandMixerHead": 450,
    "PickPlaceCounterToCabinet": 750,
    "PickPlaceCounterToStove": 600,
    "PickPlaceDrawerToCounter": 750,
    "PickPlaceSinkToCounter": 900,
    "PickPlaceToasterToCounter": 600,
    "SlideDishwasherRack": 450,
    "TurnOffStove": 750,
    "TurnOnElectricKettle": 450,
    "TurnOnMicrowave": 450,
    "TurnOnSinkFaucet": 600,
}
COMPOSITE_SEEN: Mapping[str, int] = {
    "DeliverStraw": 2550,
    "GetToastedBread": 3000,
    "KettleBoiling": 1500,
    "LoadDishwasher": 1800,
    "PackIdenticalLunches": 3900,
    "PreSoakPan": 2400,
    "PrepareCoffee": 1800,
    "RinseSinkBasin": 1350,
    "ScrubCuttingBoard": 1200,
    "SearingMeat": 4350,
    "SetUpCuttingStation": 2400,
    "StackBowlsCabinet": 2100,
    "SteamInMicrowave": 2100,
    "StirVegetables": 2400,
    "StoreLeftoversInBowl": 2550,
    "WashLettuce": 1650,
}
COMPOSITE_UNSEEN: Mapping[str, int] = {
    "ArrangeBreadBasket": 4350,
    "ArrangeTea": 2250,
    "BreadSelection": 1950,
    "CategorizeCondiments": 1650,
    "CuttingToolSelection": 1200,
    "GarnishPancake": 2700,
    "GatherTableware": 2250,
    "HeatKebabSandwich": 2700,
    "MakeIceLemonade": 3000,
    "PanTransfer": 1800,
    "PortionHotDogs": 2250,
    "RecycleBottlesByType": 2850,
    "SeparateFreezerRack": 2400,
    "WaffleReheat": 4050,
    "WashFruitColander": 3150,
    "WeighIngredients": 3000,
}
HORIZONS: Mapping[str, int] = {**ATOMIC_SEEN, **COMPOSITE_SEEN, **COMPOSITE_UNSEEN}

_KITCHENS: Mapping[str, str] = {
    "target": "one of the 10 target kitchens, with the target objects",
    "pretrain": "one of the 2500 pretraining kitchens, with the pretraining objects",
}

REGISTRIES = ("objaverse", "lightwheel")  # sets of objects from which RoboCasa draws
# RoboCasa's names of the downloads, by the folder of assets that each fills.
DOWNLOAD_TYPES = {
    "textures": "tex",
    "fixtures/stoves": "fixtures_lw",
    "objects/objaverse": "objs_objaverse",
    "objects/lightwheel": "objs_lw",
}

# robosuite's order of an action is hand, gripper, base, torso, mode. These are the indices of its
# values in an action of the datasets.
_FROM_BASE_FIRST = [*range(5, 12), *range(5)]
_GRIPPER, _MODE = 6, 11  # indices in robosuite's order
_ON = 0.5  # the threshold of RoboCasa's own Gymnasium environments: both {-1, 1} and {0, 1} work


def protocol(task: str, split: Split) -> BenchmarkProtocol:
    """Return the protocol of a task in the kitchens of `split`.

    Results are published for both splits.
    """
    return BenchmarkProtocol(
        name=f"RoboCasa365, split {split}",
        source="Nasiriany et al. 2026, arXiv 2603.04356; robocasa 1.0.1, docs/benchmarking and "
        "dataset_registry.py",
        max_steps=HORIZONS[task],
        control_hz=CONTROL_HZ,
        control="pose of the hand, delta, by OSC_POSE: 0.05 m and 0.5 rad a unit; velocity of the "
        "base",
        success="RoboCasa's own check of the task holds after a step",
        metric="success_once",
        begins=f"{_KITCHENS[split]}; the seed draws the positions of all furniture and objects in "
        f"it",
        # As in openpi's evaluation. GR00T's evaluation checks success after each chunk of 16 steps.
        ends_on_success=True,
        episodes=50,
    )


class RoboCasa(RobosuiteEnv):
    """One environment of one of RoboCasa365's tasks, e.g. "OpenDrawer".

    A Panda arm stands on an Omron base in a kitchen.

    Observation: the cameras have RoboCasa's names, and their images are upright. `state` has the
    names of RoboCasa's datasets:

    - `base_position` (3,) m and `base_rotation` (4,) xyzw: the base's pose in the world frame.
    - `end_effector_position_relative` (3,) m and `end_effector_rotation_relative` (4,) xyzw: the
      hand's pose in the base frame.
    - `gripper_qpos` (2,) m: the positions of the fingers.

    Action: (12,) in [-1, 1], in this order:

    - (3,): the base's velocity forward and to the left, 1 m/s per unit, and about its vertical
      axis, 1.5 rad/s per unit.
    - (1,): the torso's height.
    - (1,): the mode. At 0.5 or more, the base moves together with the hand.
    - (6,): the hand's target moves by 0.05 m per unit along the base's axes, and turns by 0.5 rad
      per unit about them (axis-angle).
    - (1,): the gripper closes at 0.5 or more, and opens below that.
    """

    suite, title, known = "robocasa", "RoboCasa", tuple(HORIZONS)
    packages = ("robocasa", "robosuite", "mujoco")
    cure = "run `vlagents-ray venv create robocasa` and give the evaluation's workers that Python"
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
    ) -> None:
        """Make the environment; raises the errors of `make_env`. Other options are described in
        `SimulatorEnv`.

        Args:
            task: RoboCasa's name of the task, one of `tasks()`.
            split: The kitchens and objects: "target" or "pretrain".
            cameras: RoboCasa's names of the cameras; None selects the protocol's three cameras.
            action_order: "base_first" is the order of an action in RoboCasa365's datasets.
                "arm_first" is the order of RoboCasa's `convert_action` and of LeRobot's
                environment: hand, gripper, base, torso, mode.
            object_registries: The sets of objects to draw from; the protocol uses both.
        """
        super().__init__(task, width=width, height=height, max_steps=max_steps)
        self._require_choices("split", [split], get_args(Split))
        self._require_choices("action_order", [action_order], get_args(ActionOrder))
        self._require_choices("object_registries", object_registries, REGISTRIES)
        self._protocol, self._ends_on_success = protocol(task, split), ends_on_success
        self.max_steps = max_steps or HORIZONS[task]
        self._contract = self.known_contract(
            {"width": width, "height": height, "cameras": cameras, "action_order": action_order}
        )
        self._order = _FROM_BASE_FIRST if action_order == "base_first" else list(range(12))
        self._registries = tuple(object_registries)

        require_assets(self._registries)
        with (
            failing(self._name, "import robocasa"),
            importing_robosuite("robocasa"),
            # Suppresses advice about packages that are not needed.
            contextlib.redirect_stdout(io.StringIO()),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")  # suppresses warnings of upstream code
            simulator: Any = require("robocasa")
        self._versions = {
            "robocasa": simulator.__version__,
            "robosuite": simulator.robosuite.__version__,
        }

        images = self._contract.cameras or {}
        with self._making(), seeded(0):
            env = simulator.utils.env_utils.create_env(
                task,
                split=split,
                obj_registries=self._registries,
                camera_names=list(images),
                camera_heights=height or SIZE,
                camera_widths=width or SIZE,
                renderer="mujoco",  # done for the reason given in `Robosuite`
            )
            # Set before the first reset, which loads the model.
            env.use_camera_obs = env.has_offscreen_renderer = bool(images)
            self._use(env)

    def _require_choices(self, option: str, values: Sequence[str], allowed: Sequence[str]) -> None:
        """Raise `ConfigError` unless an option has values, all of which are allowed."""
        if not values or not set(values) <= set(allowed):
            raise ConfigError(
                f"{self._name}: {option}: expected only {list(allowed)}, got {list(values)}"
            )

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        """Return the contract; the state has the names of RoboCasa365's datasets."""
        cameras = CAMERAS if arguments["cameras"] is None else arguments["cameras"]
        image = CameraSpec(arguments["height"] or SIZE, arguments["width"] or SIZE)

        if arguments["action_order"] == "base_first":
            action = replace(DELTA_POSE, dim=12, space="base_velocity+ee_pose")
        else:
            # The contract describes a gripper only as the last value of an action.
            action = replace(
                DELTA_POSE,
                dim=12,
                space="ee_pose+base_velocity",
                gripper_open=None,
                gripper_closed=None,
            )
        return Contract(
            cameras=dict.fromkeys(cameras, image),
            state={
                "base_position": StateSpec(3, "m"),
                "base_rotation": StateSpec(4, "quat_xyzw"),
                "end_effector_position_relative": StateSpec(3, "m"),
                "end_effector_rotation_relative": StateSpec(4, "quat_xyzw"),
                "gripper_qpos": StateSpec(2, "m"),
            },
            gripper=True,
            instruction=True,
            action=action,
            control_hz=CONTROL_HZ,
        )

    def describe(self) -> dict[str, Any]:
        facts = super().describe() | self._versions
        if set(self._registries) != set(REGISTRIES):
            facts["protocol"]["deviations"].append(
                f"object_registries: {list(self._registries)}, the protocol says {list(REGISTRIES)}"
            )
        return facts

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        obs, _ = super()._begin(seed, state)
        episode = self._env.get_ep_meta()
        self._instruction = str(episode["lang"])  # the instruction mentions objects of this kitchen
        return obs, {"layout": int(episode["layout_id"]), "style": int(episode["style_id"])}

    @classmethod
    def _require_assets(cls) -> None:
        require_assets()

    def _command(self, action: np.ndarray) -> np.ndarray:
        command = action[self._order]
        for switch in (_GRIPPER, _MODE):
            command[switch] = 1.0 if command[switch] >= _ON else -1.0
        return command


def require_assets(registries: Sequence[str] = REGISTRIES) -> None:
    """Check that RoboCasa's assets are installed.

    Args:
        registries: The sets of objects that are needed, besides textures and appliances.

    Raises:
        EnvFailed: Assets are missing; the message has the command that downloads them.
    """
    spec = importlib.util.find_spec("robocasa")
    if spec is None or spec.origin is None:  # `require` raises a better error
        return
    folder = Path(spec.origin).parent / "models" / "assets"
    needed = ["textures", "fixtures/stoves", *(f"objects/{name}" for name in registries)]
    missing = [name for name in needed if not (folder / name).is_dir()]
    if missing:
        types = " ".join(DOWNLOAD_TYPES[name] for name in missing)
        raise EnvFailed(
            f"robocasa: the assets in {folder} lack {missing}; download them once, about 10 GB, "
            "with that environment's Python: python -m robocasa.scripts.download_kitchen_assets "
            f"--type {types}; or make that folder a link to a copy of them"
        )
