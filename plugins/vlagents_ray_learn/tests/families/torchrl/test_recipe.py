"""TorchRL's own VLA recipe with this server: one more line, all else unchanged."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[5] / "docs/evaluation/torchrl.md"
# The recipe in a checkout of TorchRL 0.14 (github.com/pytorch/rl).
RECIPE = Path("sota-implementations/vla_grpo")
# The last import of the recipe's utils.py.
IMPORT = "from torchrl.weight_update import WeightStrategy\n"
BLOCK = re.compile(r"^from vlagents_ray_learn\.torchrl import \($.*?^\)$", re.MULTILINE | re.DOTALL)
FINAL = re.compile(r"Final greedy success rate: (\d\.\d+)")


@pytest.mark.torch
@pytest.mark.server
@pytest.mark.ray
@pytest.mark.source("TORCHRL_SRC")
def test_the_recipe_trains_with_one_more_import(tmp_path: Path) -> None:
    block = BLOCK.search(PAGE.read_text())
    assert block is not None
    folder = tmp_path / "recipe"
    shutil.copytree(Path(os.environ["TORCHRL_SRC"]) / RECIPE, folder)
    text = (folder / "utils.py").read_text()
    assert IMPORT in text
    (folder / "utils.py").write_text(text.replace(IMPORT, f"{IMPORT}{block[0]}\n"))
    settings = {
        "env.seed": 0,
        "logger.backend": "",
        "logger.eval_iter": 2,
        "logger.eval_episodes": 4,
        "checkpoint.save_iter": 0,
        "collector.groups_per_iter": 2,
        "collector.total_iters": 3,
        "loss.mini_batch_size": 8,
        "hydra.run.dir": tmp_path / "run",
    }
    done = subprocess.run(
        [sys.executable, "vla-grpo.py", *(f"{name}={value}" for name, value in settings.items())],
        cwd=folder,
        # The same setting as in TorchRL's own test of the recipe.
        env=os.environ | {"COMPOSITE_LP_AGGREGATE": "0"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    final = FINAL.search(done.stdout)
    assert done.returncode == 0, done.stdout[-4000:]
    assert final is not None, done.stdout[-4000:]
    assert 0 <= float(final[1]) <= 1
