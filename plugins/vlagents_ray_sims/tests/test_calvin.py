"""Tests of CALVIN that need no simulator: scenes, contract, hash, and the errors for a wrong
checkout.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from vlagents_ray.contract import CameraSpec
from vlagents_ray.envs.base import known_contract, make_env
from vlagents_ray.errors import ConfigError, UnknownEnv
from vlagents_ray_sims.calvin import PROTOCOL, Calvin, fnv1_32


def test_the_contract_and_the_protocol_are_known_before_the_simulator_is_made() -> None:
    known = known_contract("calvin/D", {})
    assert known is not None
    assert known.cameras == {"static": CameraSpec(200, 200), "gripper": CameraSpec(84, 84)}
    assert {name: spec.dim for name, spec in (known.state or {}).items()} == {
        "tcp_pos": 3,
        "tcp_orn": 3,
        "gripper_opening_width": 1,
        "robot_joints": 7,
    }
    assert (known.action.dim, known.action.gripper_open, known.control_hz) == (7, 1.0, 30.0)
    assert (Calvin.init_states, PROTOCOL.max_steps, PROTOCOL.episodes) == (1000, 1800, 1000)


def test_the_hash_that_places_the_blocks_is_pyhashs() -> None:
    """The hash is FNV-1 with the initial value 0 instead of the usual one. The expected number is
    from pyhash's documentation.
    """
    assert fnv1_32("hello world") == 2805756500


def test_wrong_settings_are_told_with_the_cure(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("CALVIN_SRC", raising=False)
    with pytest.raises(
        UnknownEnv, match=r"calvin: expected a task of \['A', 'B', 'C', 'D'\], got 'E'"
    ):
        make_env("calvin/E")
    with pytest.raises(ConfigError, match="renderer: expected egl or tiny, got 'vulkan'"):
        make_env("calvin/D", renderer="vulkan")
    with pytest.raises(ConfigError, match="CALVIN_SRC is not set; git clone --recurse-submodules"):
        make_env("calvin/D")
    with pytest.raises(
        ConfigError,
        match=r"expected a checkout .* with its submodules .*got none of \['calvin_env/conf'",
    ):
        make_env("calvin/D", source_dir=str(tmp_path))
