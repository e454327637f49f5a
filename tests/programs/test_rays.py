"""A server with minor versions of Ray, both allowed and other ones: `make rays`."""

from __future__ import annotations

from pathlib import Path

import pytest
from versions import check, require_everything

from vlagents_ray.ray_tools.private import TRIED

pytestmark = [pytest.mark.server, pytest.mark.slow]

# The last patch release of each minor version.
RAYS = ("2.56.1", "2.57.1", "2.58.1", "2.59.0", "2.60.0")


def test_each_minor_version_that_is_allowed_is_tried() -> None:
    (major, oldest), (_, newest) = TRIED
    allowed = {f"{major}.{minor}" for minor in range(oldest, newest + 1)}
    assert allowed <= {version.rpartition(".")[0] for version in RAYS}


@pytest.mark.parametrize("version", RAYS)
def test_a_server_acts_is_evaluated_and_rolled_out_with(version: str, tmp_path: Path) -> None:
    printed = check("3.11", tmp_path, version)
    assert printed["ray"] == version
    require_everything(printed, rollouts=True)
