"""Episodes of an evaluation in Rerun."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from eval_fakes import ToZero
from rerun_files import read_rrd

from vlagents_ray.evaluate import EvalConfig, evaluate
from vlagents_ray.evaluate.artifacts.trajectory import Trajectory

Config = Callable[..., EvalConfig]
CAMERA = {"camera": [32, 32]}


@pytest.mark.library("rerun")
def test_a_file_of_each_episode_is_what_was_seen_and_done(config: Config, tmp_path: Path) -> None:
    settings = config(episodes=3, record="all", env_options=CAMERA, rerun=str(tmp_path / "rrd"))
    results = evaluate(settings, agent_factory=ToZero, in_process=True).results
    for episode in results.cells[0].episodes:
        trajectory = Trajectory.load(results.out / str(episode.trajectory))
        [file] = (tmp_path / "rrd").rglob(f"ep{episode.result.key.episode:04d}_*.rrd")
        assert file.stem.endswith("success") == episode.result.success_once
        shown = read_rrd(file)
        actions = trajectory.actions[:, 0].tolist()
        assert [values[0] for _, values in sorted(shown["action/executed"].items())] == actions
        positions = trajectory.state["position"][:, 0].tolist()
        assert [values[0] for _, values in sorted(shown["state/position"].items())] == positions
        assert len(shown["cameras/front"]) == episode.result.steps + 1
        assert sum(values[0] for values in shown["timing/reward"].values()) == pytest.approx(
            episode.result.episode_return
        )
        planned = [rows for _, rows in sorted(shown["action/chunk"].items())]
        assert np.concatenate(planned)[: len(actions), 0].tolist() == actions
