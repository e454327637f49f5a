"""TorchRL's own VLA recipe with this server: one more line, all else unchanged."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from benchmarks.torchrl import LINE, play, prepare

PAGE = Path(__file__).parents[5] / "docs/evaluation/torchrl.md"


@pytest.mark.torch
@pytest.mark.server
@pytest.mark.ray
@pytest.mark.source("TORCHRL_SRC")
def test_the_recipe_trains_with_one_more_line(tmp_path: Path) -> None:
    assert LINE in PAGE.read_text()
    program = prepare(Path(os.environ["TORCHRL_SRC"]), tmp_path / "recipe", LINE)
    words = ["collector.groups_per_iter=2", "collector.total_iters=3", "loss.mini_batch_size=8"]
    found = play(
        program, Path(sys.executable), 0, [*words, "logger.eval_iter=2", "logger.eval_episodes=4"]
    )
    assert 0 <= found["success"] <= 1
