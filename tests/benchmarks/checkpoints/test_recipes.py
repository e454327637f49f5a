"""A family's checkpoint is created completely or not at all, with a deployment file that
serves it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.checkpoints import recipes
from benchmarks.checkpoints.recipe import Recipe, WrittenCheckpoint
from benchmarks.checkpoints.recipes import FAMILIES, Family, write_checkpoint
from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.registry import requirements_file
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import policy_application

Known = Callable[..., list[Recipe]]


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> Known:
    """Register a family `own`, and return a growing list of the requests for it."""

    def add(*packages: str, fails: bool = False) -> list[Recipe]:
        asked: list[Recipe] = []

        def write(recipe: Recipe) -> WrittenCheckpoint:
            asked.append(recipe)
            (recipe.folder / "half").write_text("")
            if fails:
                raise ConfigError("half")
            return WrittenCheckpoint("noop", 1234, {"base_ms": 3.0})

        monkeypatch.setitem(sys.modules, f"{recipes.__package__}.own", SimpleNamespace(write=write))
        monkeypatch.setitem(FAMILIES, "own", Family("own", "hf", packages))
        return asked

    return add


@pytest.mark.torch
def test_the_deployment_file_serves_the_checkpoint_with_this_python(
    tmp_path: Path, known: Known
) -> None:
    asked = known()
    written = write_checkpoint("own", tmp_path / "made", "small")
    assert asked == [Recipe("own", tmp_path / "made", "small", "bfloat16")]
    args = ServerArgs(**policy_application(str(tmp_path / "made" / "deployment.yaml")).args)
    assert (args.policy, args.config) == (written.policy, written.config)
    assert args.environment.python == sys.executable
    assert args.batch.max_size == 32
    assert "1,234 random parameters" in (tmp_path / "made" / "deployment.yaml").read_text()


def test_half_a_checkpoint_is_removed(tmp_path: Path, known: Known) -> None:
    known(fails=True)
    with pytest.raises(ConfigError, match="half"):
        write_checkpoint("own", tmp_path / "made")
    assert list(tmp_path.iterdir()) == []


def test_what_is_in_a_folder_stays(tmp_path: Path, known: Known) -> None:
    asked = known()
    (tmp_path / "weights").write_text("precious")
    for folder in (tmp_path, tmp_path / "weights"):
        with pytest.raises(ConfigError, match="exists already"):
            write_checkpoint("own", folder)
    assert (tmp_path / "weights").read_text() == "precious"
    assert asked == []


def test_a_missing_package_names_the_environment_with_it(tmp_path: Path, known: Known) -> None:
    known("no_such_package")
    with pytest.raises(
        MissingDependency, match=r"no_such_package.*venv create hf .*benchmarks\.checkpoints own"
    ):
        write_checkpoint("own", tmp_path / "made")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", FAMILIES)
def test_the_environment_of_a_family_is_one_that_can_be_made(name: str) -> None:
    family = FAMILIES[name]
    assert requirements_file(family.environment).is_file()
    assert (Path(recipes.__file__).parent / f"{family.module}.py").is_file()
