"""Datasets of ours, read by LeRobot itself."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
import torch
from eval_fakes import LINE
from flat_config import flat_config
from lerobot.datasets import lerobot_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from played import play

from vlagents_ray.evaluate.exports import to_lerobot
from vlagents_ray.evaluate.trajectory import Trajectory


def decode(path: Path, timestamps: list[float], tolerance_s: float, _backend: str) -> torch.Tensor:
    """The pictures at these times, (N, 3, H, W) in [0, 1], which newer versions of torchvision do not give LeRobot."""
    with av.open(str(path)) as container:
        frames = [(float(frame.time), frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    nearest = [min(frames, key=lambda frame: abs(frame[0] - wanted)) for wanted in timestamps]
    assert all(abs(found - wanted) < tolerance_s for (found, _), wanted in zip(nearest, timestamps, strict=True))
    return torch.from_numpy(np.stack([image for _, image in nearest])).permute(0, 3, 1, 2) / 255


def test_lerobot_reads_what_an_evaluation_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lerobot_dataset, "decode_video_frames", decode)
    options = {"envs": [LINE], "episodes": 3, "env_options": {"camera": [32, 48], "state_dim": 2}}
    results = play(flat_config(**options, record="all", video="none", out=tmp_path / "out"))
    to_lerobot(results, tmp_path / "dataset")
    dataset = LeRobotDataset("evaluation/line", root=tmp_path / "dataset", video_backend="pyav")
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (3, 30, 10)
    frames = iter(dataset)
    for episode in results.cells[0].episodes:
        trajectory = Trajectory.load(results.out / str(episode.trajectory))
        for i in range(10):
            frame = next(frames)
            assert frame["action"].numpy().reshape(-1).tolist() == trajectory.actions[i].tolist()
            assert frame["observation.state"].numpy().tolist() == trajectory.state["position"][i].tolist()
            assert frame["observation.state.position"].numpy().tolist() == trajectory.state["position"][i].tolist()
            assert float(frame["next.reward"]) == np.float32(trajectory.rewards[i])
            assert bool(frame["next.success"]) == trajectory.success[i]
            assert bool(frame["next.done"]) == (i == 9)
            assert frame["task"] == episode.result.instruction
            image = frame["observation.images.front"]
            assert image.shape == (3, 32, 48)
            assert 255 * float(image[0].mean()) == pytest.approx(20 * i, abs=6)
    assert dataset.meta.stats["action"]["count"] == [30]
    assert dataset.meta.features["action"]["spec"]["dim"] == 1
