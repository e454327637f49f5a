"""π0.5 of `python -m benchmarks.checkpoints`, where transformers has openpi's changes: see
`collect_ignore`.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.checkpoints import lerobot as recipe
from benchmarks.checkpoints.recipe import Recipe
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import FILTERS

pytestmark = FILTERS


@pytest.mark.verifies("size")
def test_the_full_size_is_the_published_one(tmp_path: Path) -> None:
    policy, _ = recipe.make_policy(Recipe("pi05", tmp_path, "full", "bfloat16"))
    parameters = sum(parameter.numel() for parameter in policy.parameters())
    assert parameters == pytest.approx(3.6e9, rel=0.03)
