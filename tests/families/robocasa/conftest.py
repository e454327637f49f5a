"""RoboCasa as it really runs, in a kitchen of stand-ins for its assets; one environment serves several tests."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.families.robocasa.stand_ins import write_package
from vlagents_ray.envs.robocasa import RoboCasa


@pytest.fixture(scope="package", autouse=True)
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder with a robocasa that has stand-ins as its assets, which this process imports."""
    assert "robocasa" not in sys.modules
    folder = write_package(tmp_path_factory.mktemp("robocasa"))
    sys.path.insert(0, str(folder))
    yield folder
    sys.path.remove(str(folder))


@pytest.fixture(scope="package")
def drive(kitchen: Path) -> Iterator[RoboCasa]:
    with RoboCasa("NavigateKitchen", width=32, height=24) as env:
        yield env
