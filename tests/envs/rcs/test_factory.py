"""What users of RCS and DuoBench are told where these cannot run."""

from __future__ import annotations

import importlib.machinery
import importlib.util
from pathlib import Path

import pytest

from vlagents_ray.envs import make_env
from vlagents_ray.envs.rcs import DuoBench, Rcs
from vlagents_ray.errors import ConfigError, MissingDependency, UnknownEnv


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """As if both packages were there; the home folder, without their assets."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: importlib.machinery.ModuleSpec(name, None))
    monkeypatch.setenv("HOME", str(tmp_path))
    for variable in ("RCS_PREFIX", "DUOBENCH_PREFIX"):
        monkeypatch.delenv(variable, raising=False)
    return tmp_path


def put_assets(prefix: Path) -> None:
    scene = prefix / "assets/scenes/empty_world/scene.xml"
    scene.parent.mkdir(parents=True)
    scene.touch()


def test_without_the_package_the_environment_to_make_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", {}.get)
    with pytest.raises(MissingDependency, match=r"rcs/pick: rcs is not installed.*requirements/rcs.txt.*py_executable"):
        make_env("rcs/pick")
    assert "rcs is not installed" in (DuoBench.missing() or "")


def test_without_assets_the_package_is_not_imported(installed: Path) -> None:
    with pytest.raises(MissingDependency, match=rf"not in {installed}/.rcs: .*set RCS_PREFIX"):
        make_env("rcs/pick")


def test_assets_are_looked_for_where_the_packages_keep_them(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    with pytest.raises(ConfigError, match="height is 0"):
        make_env("rcs/pick", height=0)
