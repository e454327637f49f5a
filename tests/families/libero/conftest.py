"""LIBERO as it really runs, on the assets that tests find; one environment serves several tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from needs import assets

from vlagents_ray.envs.libero import Libero


@pytest.fixture(scope="package")
def folder() -> str:
    found = assets("libero")
    assert found is not None  # the marker skips the test otherwise
    return str(found)


@pytest.fixture(scope="package")
def bowl(folder: str) -> Iterator[Libero]:
    """Picks a bowl from between a plate and a ramekin; the cabinet stands where the simulator draws."""
    with Libero("libero_spatial/0", width=64, height=64, assets=folder) as env:
        yield env


@pytest.fixture(scope="package")
def soup(folder: str) -> Iterator[Libero]:
    with Libero("libero_object/0", width=32, height=32, assets=folder) as env:
        yield env
