"""Wrappers of robots: each wrapper has all attributes of the inner robot, through one mechanism."""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import vlagents_ray
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.evaluate.robot.trial import WatchedRobot
from vlagents_ray.interface import Obs
from vlagents_ray.robot.loop import robot_watchdog
from vlagents_ray.robot.wrapper import RobotWrapper

ROOT = Path(vlagents_ray.__file__).parents[1]
WRAPPERS: list[type[RobotWrapper]] = [RobotWrapper, WatchedRobot]
OPTIONAL = {  # attributes that the package reads, and one that it does not know
    "simulated": True,
    "holds": "the wrist camera hangs",
    "contract": Contract(action=ActionSpec(dim=2)),
    "joint_names": ["pan", "lift"],
    "joint_limits": [(-1.0, 1.0), (-2.0, 2.0)],
    "operator": object(),
    "clock": object(),
    "silent_s": {"/joint_states": 1.0},
    "watchdog": None,
    "measure": lambda obs: obs.state["joints"],
    "grippers": [1],
    "of_a_later_release": 7,
}


class Arm:
    def __init__(self) -> None:
        self.calls: list[str] = []

    def observe(self) -> Obs:
        self.calls.append("observe")
        return Obs()

    def apply(self, action: np.ndarray) -> None:
        self.calls.append("apply")

    def stop(self) -> None:
        self.calls.append("stop")

    def close(self) -> None:
        self.calls.append("close")


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize("depth", [1, 2])
@pytest.mark.parametrize("name", OPTIONAL)
def test_a_wrapper_has_each_attribute_of_its_robot_now(
    wrapper: type[RobotWrapper], depth: int, name: str
) -> None:
    arm = Arm()
    wrapped = wrapper(arm)
    for _ in range(depth - 1):
        wrapped = wrapper(wrapped)
    assert not hasattr(wrapped, name), "an attribute that the robot lacks is not invented"
    setattr(arm, name, OPTIONAL[name])
    assert getattr(wrapped, name) is OPTIONAL[name]
    setattr(wrapped, name, "set from outside")
    assert getattr(arm, name) == "set from outside"
    delattr(arm, name)
    assert not hasattr(wrapped, name)


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_a_wrapper_calls_its_robot_and_can_be_copied(wrapper: type[RobotWrapper]) -> None:
    arm = Arm()
    wrapped = wrapper(arm)
    wrapped.observe()
    wrapped.apply(np.zeros(2, np.float32))
    wrapped.stop()
    wrapped.close()
    assert arm.calls == ["observe", "apply", "stop", "close"]
    copied = copy.deepcopy(wrapped)
    copied.stop()
    assert arm.calls[-1] == "close", "the copy has a separate robot"


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_the_watchdog_of_a_wrapped_robot_also_watches_the_robots_own_sources(
    wrapper: type[RobotWrapper],
) -> None:
    arm = Arm()
    arm.silent_s = {"/joint_states": 0.01}  # type: ignore[attr-defined]
    arm.watchdog = None  # type: ignore[attr-defined]
    reasons: list[str] = []
    with robot_watchdog(wrapper(arm), reasons.append, {"server": 60.0}) as watchdog:
        assert arm.watchdog is watchdog  # type: ignore[attr-defined]
        while not reasons:
            watchdog.heard("server")
    assert reasons[0].startswith("/joint_states: silent")


def classes_that_name_robots() -> Iterator[tuple[str, ast.ClassDef]]:
    """Return the classes of modules that contain the word Robot; other modules need no parsing."""
    for folder in ("vlagents_ray", "plugins", "examples", "benchmarks"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            source = path.read_text(encoding="utf-8")
            if "Robot" not in source:
                continue
            for node in ast.walk(ast.parse(source)):
                if isinstance(node, ast.ClassDef):
                    yield str(path.relative_to(ROOT)), node


def wraps_a_robot(node: ast.ClassDef) -> bool:
    """Return whether a class with the methods of a robot is constructed from a robot."""
    methods = {one.name: one for one in node.body if isinstance(one, ast.FunctionDef)}
    made = methods.get("__init__")
    takes = (
        []
        if made is None
        else [one.annotation for one in made.args.args if one.annotation is not None]
    )
    return (
        "apply" in methods
        and "stop" in methods
        and any(ast.unparse(one) == "Robot" for one in takes)
    )


@pytest.mark.slow
def test_every_class_around_a_robot_derives_from_the_one_wrapper() -> None:
    robot_classes = list(classes_that_name_robots())
    bases = {node.name: [ast.unparse(base) for base in node.bases] for _, node in robot_classes}
    around = [name for name, above in bases.items() if "RobotWrapper" in above]
    assert sorted(around) == sorted(one.__name__ for one in WRAPPERS if one is not RobotWrapper), (
        "add it to WRAPPERS"
    )
    others = [
        f"{path}: {node.name}"
        for path, node in robot_classes
        if wraps_a_robot(node) and node.name not in around
    ]
    assert others == ["vlagents_ray/robot/wrapper.py: RobotWrapper"]
