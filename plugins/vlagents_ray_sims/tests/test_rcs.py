"""Tests of the conversion between flat rows and RCS's dicts, and of the errors where RCS and
DuoBench cannot run.
"""

from __future__ import annotations

import importlib.machinery
import importlib.util
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from vlagents_ray.contract import ActionSpec
from vlagents_ray.envs import make_env
from vlagents_ray.errors import ConfigError, MissingDependency, UnknownEnv
from vlagents_ray_sims.rcs import Arms, DuoBench, Rcs

_SIZES = {"joints": 7, "tquat": 7, "xyzrpy": 6}


def spaces(
    *names: str, mode: str = "joints", gripper: bool = True
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the action space and the observation space of robots with these names, in RCS's
    format.
    """

    def boxes(parts: dict[str, int]) -> Any:
        sized = parts | ({"gripper": 1} if gripper else {})
        return gymnasium.spaces.Dict(
            {part: gymnasium.spaces.Box(-9, 9, (size,)) for part, size in sized.items()}
        )

    return {name: boxes({mode: _SIZES[mode]}) for name in names}, {
        name: boxes(_SIZES) for name in names
    }


def seen(*names: str, gripper: float = 1.0) -> dict[str, Any]:
    """Return an observation in which all values of the first robot are 0, and all values of the
    second robot 1.
    """
    return {
        name: {part: np.full(size, i, np.float64) for part, size in _SIZES.items()}
        | {"gripper": [gripper]}
        for i, name in enumerate(names)
    }


def test_a_row_is_each_arms_command_then_its_gripper() -> None:
    arms = Arms(*spaces("left", "right"), "joints")
    command = arms.command(np.arange(16, dtype=np.float32))
    assert command["left"]["joints"].tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert command["left"]["gripper"].tolist() == [7]
    assert command["right"]["joints"].tolist() == [8, 9, 10, 11, 12, 13, 14]
    assert command["right"]["gripper"].tolist() == [15]
    assert command["left"]["joints"].dtype == np.float64


def test_arms_without_gripper_take_none() -> None:
    arms = Arms(*spaces("left", "right", mode="xyzrpy", gripper=False), "xyzrpy")
    assert {
        name: list(parts) for name, parts in arms.command(np.zeros(12, np.float32)).items()
    } == {
        "left": ["xyzrpy"],
        "right": ["xyzrpy"],
    }
    spec = arms.action_spec(delta=False)
    assert (spec.dim, spec.gripper_open, spec.gripper_closed) == (12, None, None)


def test_parts_of_one_arm_are_plain_and_of_several_begin_with_its_name() -> None:
    assert set(Arms(*spaces("right", mode="tquat"), "tquat").state) == {"joints", "tquat", "xyzrpy"}
    several = Arms(*spaces("left", "right", mode="tquat"), "tquat").state
    assert len(several) == 8
    assert {"left/joints", "left/gripper", "right/xyzrpy"} < set(several)


def test_an_observation_becomes_the_parts_that_the_contract_states() -> None:
    arms = Arms(*spaces("left", "right"), "joints")
    state, gripper = arms.read(seen("left", "right", gripper=1.0000001))
    assert {name: (part.shape, part.dtype) for name, part in state.items()} == {
        name: ((spec.dim,), np.float32) for name, spec in arms.state.items()
    }
    assert (state["left/joints"].max(), state["right/joints"].min()) == (0, 1)
    assert (gripper, state["left/gripper"].tolist()) == (None, [1.0])


@pytest.mark.parametrize(("opening", "told"), [(-0.01, 0.0), (0.25, 0.25), (1.01, 1.0)])
def test_a_single_arms_gripper_is_the_observations(opening: float, told: float) -> None:
    assert (
        Arms(*spaces("right", mode="tquat"), "tquat").read(seen("right", gripper=opening))[1]
        == told
    )


def test_the_contract_says_what_is_commanded_and_in_which_order() -> None:
    assert Arms(*spaces("left", "right", mode="tquat"), "tquat").action_spec(
        delta=True
    ) == ActionSpec(
        dim=16,
        space="ee_pose",
        delta=True,
        rotation="quat_xyzw",
        frame="base",
        gripper_open=1.0,
        gripper_closed=0.0,
        arms=("left", "right"),
    )
    assert Arms(*spaces("right"), "joints").action_spec(delta=False).arms is None


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Pretend that both packages are installed, and return a home folder without their assets."""
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: importlib.machinery.ModuleSpec(name, None)
    )
    monkeypatch.setenv("HOME", str(tmp_path))
    for variable in ("RCS_PREFIX", "DUOBENCH_PREFIX"):
        monkeypatch.delenv(variable, raising=False)
    return tmp_path


def put_assets(prefix: Path) -> None:
    scene = prefix / "assets/scenes/empty_world/scene.xml"
    scene.parent.mkdir(parents=True)
    scene.touch()


def test_without_the_package_the_environment_to_make_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", {}.get)
    with pytest.raises(
        MissingDependency, match=r"rcs/pick: rcs is not installed.*venv create rcs`.*py_executable"
    ):
        make_env("rcs/pick")
    assert "rcs is not installed" in (DuoBench.missing() or "")


def test_without_assets_the_package_is_not_imported(installed: Path) -> None:
    with pytest.raises(MissingDependency, match=rf"not in {installed}/.rcs: .*set RCS_PREFIX"):
        make_env("rcs/pick")


@pytest.mark.slow
def test_assets_are_looked_for_where_the_packages_keep_them(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_assets(installed / ".rcs")
    assert Rcs.missing() is None
    assert "set DUOBENCH_PREFIX" in (DuoBench.missing() or "")
    put_assets(installed / "elsewhere")
    monkeypatch.setenv("DUOBENCH_PREFIX", "~/elsewhere")
    assert DuoBench.missing() is None


def test_a_scene_of_duobench_under_another_name_wants_its_assets_too(installed: Path) -> None:
    put_assets(installed / ".rcs")
    with pytest.raises(MissingDependency, match="set DUOBENCH_PREFIX"):
        make_env("rcs/duobench/transfer_cube", max_steps=5)


def test_tasks_are_known_without_the_packages() -> None:
    assert Rcs.tasks() == ["pick"]
    assert len(DuoBench.tasks()) == 11
    with pytest.raises(UnknownEnv, match="transfer_cube"):
        make_env("duobench/juggle")
    with pytest.raises(ConfigError, match="height: expected a number of at least 1, got 0"):
        make_env("rcs/pick", height=0)
