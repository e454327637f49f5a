"""Episodes of an evaluation in viewers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from eval_fakes import ToZero
from pydantic import ValidationError
from viewer_files import read_mcap, read_rrd

from vlagents_ray.evaluate import EvalConfig, evaluate
from vlagents_ray.evaluate.artifacts.trajectory import Trajectory

Config = Callable[..., EvalConfig]
CAMERA = {"camera": [32, 32]}


@pytest.mark.library("rerun")
@pytest.mark.library("foxglove")
@pytest.mark.library("mcap")
def test_a_file_of_each_episode_is_what_was_seen_and_done(config: Config, tmp_path: Path) -> None:
    folders = {"rerun": str(tmp_path / "rrd"), "foxglove": str(tmp_path / "mcap")}
    settings = config(episodes=3, record="all", env_options=CAMERA, **folders)
    results = evaluate(settings, agent_factory=ToZero, in_process=True).results
    for episode in results.cells[0].episodes:
        trajectory = Trajectory.load(results.out / str(episode.trajectory))
        number = f"ep{episode.result.key.episode:04d}_"
        [rrd] = (tmp_path / "rrd").rglob(f"{number}*.rrd")
        [mcap] = (tmp_path / "mcap").rglob(f"{number}*.mcap")
        assert rrd.stem == mcap.stem
        assert rrd.stem.endswith("success") == episode.result.success_once
        shown, messages = read_rrd(rrd), read_mcap(mcap)
        actions = trajectory.actions[:, 0].tolist()
        assert [values[0] for _, values in sorted(shown["action/executed"].items())] == actions
        assert [message["executed"][0] for message in messages["/action"]] == actions
        positions = trajectory.state["position"][:, 0].tolist()
        assert [values[0] for _, values in sorted(shown["state/position"].items())] == positions
        assert [message["position"][0] for message in messages["/state"]] == positions
        assert len(shown["cameras/front"]) == len(messages["/cameras/front"]) == episode.result.steps + 1
        assert sum(values[0] for values in shown["timing/reward"].values()) == pytest.approx(
            episode.result.episode_return
        )
        planned = [message["rows"] for message in messages["/chunk"]]
        assert np.concatenate(planned)[: len(actions), 0].tolist() == actions


def test_workers_have_no_address_to_listen_at(config: Config) -> None:
    with pytest.raises(ValidationError, match="got 'live', want a folder"):
        config(foxglove="live")
