"""Tests of RoboCasa's tasks that need no RoboCasa: protocols, contracts, options, and missing
assets.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from vlagents_ray.contract import CameraSpec
from vlagents_ray.envs.base import known_contract, make_env
from vlagents_ray.errors import ConfigError, EnvFailed, MissingDependency, UnknownEnv
from vlagents_ray_sims.robocasa import HORIZONS, RoboCasa, protocol, require_assets


def test_the_protocol_is_robocasa365s() -> None:
    assert len(HORIZONS) == len(RoboCasa.tasks()) == 50
    drawer, pretrain = protocol("OpenDrawer", "target"), protocol("OpenDrawer", "pretrain")
    assert (drawer.max_steps, drawer.episodes, drawer.control_hz, drawer.ends_on_success) == (
        750,
        50,
        20.0,
        True,
    )
    assert (
        "10 target kitchens" in drawer.begins,
        "2500 pretraining kitchens" in pretrain.begins,
    ) == (True, True)
    assert drawer.describe(max_steps=500)["deviations"] == ["max_steps: 500, the protocol says 750"]


def test_the_contract_is_known_before_the_simulator_is_made() -> None:
    base_first = known_contract("robocasa/OpenDrawer", {})
    assert base_first is not None
    assert base_first.cameras == dict.fromkeys(
        ("robot0_agentview_left", "robot0_agentview_right", "robot0_eye_in_hand"),
        CameraSpec(256, 256),
    )
    assert base_first.state is not None
    assert sum(spec.dim or 0 for spec in base_first.state.values()) == 16
    action = base_first.action
    assert (action.dim, action.space, action.gripper_closed) == (12, "base_velocity+ee_pose", 1.0)
    arm_first = known_contract(
        "robocasa/OpenDrawer", {"action_order": "arm_first", "width": 96, "cameras": []}
    )
    assert arm_first is not None
    assert (arm_first.cameras, arm_first.action.gripper_closed) == ({}, None), (
        "which is not the last number there"
    )


@pytest.mark.parametrize(
    ("name", "options", "error", "message"),
    [
        ("robocasa/OpenDrawers", {}, UnknownEnv, "did you mean 'OpenDrawer'"),
        (
            "robocasa/OpenDrawer",
            {"split": "test"},
            ConfigError,
            r"split: expected only \['target'.*got \['test'\]",
        ),
        ("robocasa/OpenDrawer", {"action_order": "any"}, ConfigError, "action_order"),
        ("robocasa/OpenDrawer", {"object_registries": ["aigen"]}, ConfigError, "object_registries"),
    ],
)
def test_a_wrong_option_is_named(
    name: str, options: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        make_env(name, **options)


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a robocasa with only the files of its wheel; it is never imported."""
    folder = tmp_path / "robocasa"
    (folder / "models" / "assets" / "fixtures").mkdir(parents=True)
    (folder / "__init__.py").write_text("raise AssertionError")
    monkeypatch.syspath_prepend(tmp_path)
    return folder


def test_missing_assets_are_named_with_the_command_that_downloads_them(package: Path) -> None:
    with pytest.raises(
        EnvFailed,
        match=r"lack \['textures', 'fixtures/stoves', 'objects/objaverse', .*--type tex fix",
    ):
        RoboCasa("OpenDrawer")
    for part in ("textures", "fixtures/stoves", "objects/lightwheel"):
        (package / "models" / "assets" / part).mkdir(parents=True)
    with pytest.raises(
        EnvFailed,
        match=r"lack \['objects/objaverse'\].*download_kitchen_assets --type objs_objaverse;",
    ):
        RoboCasa("OpenDrawer")
    require_assets(["lightwheel"])


def test_making_one_without_robocasa_names_the_cure() -> None:
    with pytest.raises(MissingDependency, match="venv create robocasa`"):
        RoboCasa("OpenDrawer")
