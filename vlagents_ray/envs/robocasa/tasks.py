"""The fifty tasks of RoboCasa365's evaluation by name, and their published protocol."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.benchmark_protocol import BenchmarkProtocol

CONTROL_HZ = 20.0
SIZE = 256  # of each image, pixels: the datasets', and those that RoboCasa's own Gymnasium environments render
CAMERAS = ("robot0_agentview_left", "robot0_agentview_right", "robot0_eye_in_hand")

Split = Literal["target", "pretrain"]
SPLITS: tuple[Split, ...] = get_args(Split)

ActionOrder = Literal["base_first", "arm_first"]
ACTION_ORDERS: tuple[ActionOrder, ...] = get_args(ActionOrder)

# RoboCasa's three sets of tasks with their horizons in steps, from version 1.0.1, dataset_registry.py: those of 1.0.0
# times one and a half.
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


def protocol(task: str, split: Split) -> BenchmarkProtocol:
    """Return the protocol of a task in the kitchens of a split; both splits are published."""
    return BenchmarkProtocol(
        name=f"RoboCasa365, split {split}",
        source="Nasiriany et al. 2026, arXiv 2603.04356; robocasa 1.0.1, docs/benchmarking and dataset_registry.py",
        max_steps=HORIZONS[task],
        control_hz=CONTROL_HZ,
        control="pose of the hand, delta, by OSC_POSE: 0.05 m and 0.5 rad a unit; velocity of the base",
        success="RoboCasa's own check of the task holds after a step",
        begins=f"{_KITCHENS[split]}, and where everything stands and lies in it: the seed's",
        ends_on_success=True,  # as openpi's evaluation; GR00T's looks at the end of each chunk of 16 steps
        episodes=50,
    )


def contract(cameras: Mapping[str, CameraSpec], order: ActionOrder) -> Contract:
    """Return the contract of an env; names of the state are those of RoboCasa365's datasets."""
    last = order == "base_first"  # where the gripper is last, as it is in other envs
    return Contract(
        cameras=cameras,
        state={
            "base_position": StateSpec(3, "m"),
            "base_rotation": StateSpec(4, "quat_xyzw"),
            "end_effector_position_relative": StateSpec(3, "m"),
            "end_effector_rotation_relative": StateSpec(4, "quat_xyzw"),
            "gripper_qpos": StateSpec(2, "m"),
        },
        gripper=True,
        instruction=True,
        action=ActionSpec(
            dim=12,
            space="base_velocity+ee_pose" if last else "ee_pose+base_velocity",
            delta=True,
            rotation="axis_angle",
            frame="base",
            gripper_open=-1.0 if last else None,
            gripper_closed=1.0 if last else None,
            low=-1.0,
            high=1.0,
        ),
        control_hz=CONTROL_HZ,
    )
