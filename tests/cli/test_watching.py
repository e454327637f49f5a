"""What is wrong with a file for `--watch` is said before anything is looked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from vlagents_ray.cli.watching import watch_training
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig

SWEPT = {"name": "swept", "url": "http://127.0.0.1:9", "checkpoint": "/runs/{step}"}
FIXED = {"name": "fixed", "url": "http://127.0.0.1:9", "checkpoint": "/runs/9"}


@pytest.mark.parametrize(
    ("policies", "text"),
    [
        ([FIXED], "in the checkpoints of 0 policies, want it in that of one"),
        ([SWEPT, SWEPT | {"name": "other"}], "in the checkpoints of 2 policies"),
        ([SWEPT | {"steps": [10]}], "--watch finds its steps; leave `steps` out"),
    ],
)
def test_one_policy_has_a_place_for_the_step_and_names_none(
    policies: list[dict[str, Any]], text: str, tmp_path: Path
) -> None:
    config = EvalConfig.model_validate(
        {"policies": policies, "suites": [{"envs": ["tabletop"]}], "out": tmp_path / "o"}
    )
    with pytest.raises(ConfigError, match=text):
        watch_training(config, tmp_path)


def test_a_training_that_ends_without_a_checkpoint_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "training_finished").touch()
    config = EvalConfig.model_validate({"policies": [SWEPT], "suites": [{"envs": ["tabletop"]}], "out": tmp_path / "o"})
    with pytest.raises(ConfigError, match="ended without a checkpoint"):
        watch_training(config, tmp_path)


def test_results_of_before_are_told_before_the_first_checkpoint_is_there(tmp_path: Path) -> None:
    (tmp_path / "results.db").touch()
    config = EvalConfig.model_validate({"policies": [SWEPT], "suites": [{"envs": ["tabletop"]}], "out": tmp_path})
    with pytest.raises(ConfigError, match="resume them"):
        watch_training(config, tmp_path / "runs")
