"""π0.5 of `vlagents-ray bench checkpoint`, where transformers has openpi's changes: see `collect_ignore`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.families.lerobot.conftest import FILTERS
from vlagents_ray.bench.checkpoints import lerobot as recipe
from vlagents_ray.bench.checkpoints.recipe import Recipe

pytestmark = FILTERS


@pytest.mark.verifies("size")
def test_the_full_size_is_the_published_one(tmp_path: Path) -> None:
    policy, _ = recipe.make_policy(Recipe("pi05", tmp_path, "full", "bfloat16"))
    assert sum(one.numel() for one in policy.parameters()) == pytest.approx(3.6e9, rel=0.03)
