"""Environments of LIBERO with the assets of its packages; one environment serves several tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from vlagents_ray_sims.libero import Libero


@pytest.fixture(scope="package")
def bowl() -> Iterator[Libero]:
    """The task is to pick the bowl between a plate and a ramekin; the simulator draws the position
    of the cabinet.
    """
    with Libero("libero_spatial/0", width=64, height=64) as env:
        yield env


@pytest.fixture(scope="package")
def soup() -> Iterator[Libero]:
    with Libero("libero_object/0", width=32, height=32) as env:
        yield env
