"""The installed Ray has the private names that this package uses."""

from __future__ import annotations

import pytest
import ray_names

pytestmark = pytest.mark.ray


@pytest.mark.parametrize("place", ray_names.PLACES)
def test_ray_has_the_private_names_that_are_used(place: str) -> None:
    names = ray_names.used(ray_names.PACKAGE / place)
    assert names
    assert {name: gone for name in names if (gone := ray_names.missing(name)) is not None} == {}


def test_a_name_that_is_gone_is_noticed() -> None:
    assert (
        ray_names.missing("ray._private.worker.no_such_name.more")
        == "ray._private.worker.no_such_name"
    )
    assert ray_names.missing("ray._private.no_such_module.name") == "ray._private.no_such_module"
    assert ray_names.missing("ray.serve._private.common.RequestMetadata.no_such_field") is not None
