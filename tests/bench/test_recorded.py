"""Observations of recorded trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vlagents_ray.bench.tuner import recorded_observations
from vlagents_ray.bench.tuning_process import load_observations, save_observations
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import Trajectory
from vlagents_ray.images.mp4 import Mp4


def record(file: Path, first: float, steps: int = 5, frames: int = 6, part: str = "arm/joints") -> None:
    """Observation i has first + i as its joints, and an image as bright as 20 i."""
    state = {part: first + np.arange(steps + 1, dtype=np.float32)[:, None] * np.ones(2, np.float32)}
    trajectory = Trajectory(
        np.zeros((steps, 2), np.float32), np.zeros(steps), np.zeros(steps, bool), state,
        np.linspace(0, 1, steps + 1, dtype=np.float32), ("front",), np.full(steps, -1),
    )  # fmt: skip
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(trajectory.to_bytes())
    video = Mp4(file.with_name(f"{file.stem}_front.mp4"), (16, 16, 3), 20)
    for i in range(frames):
        video.add(np.full((16, 16, 3), 20 * i, np.uint8))
    video.finish()


def test_they_are_spread_over_episodes_and_their_steps(tmp_path: Path) -> None:
    record(tmp_path / "a" / "ep0.npz", 0.0)
    record(tmp_path / "b" / "ep1.npz", 100.0)
    found = recorded_observations(tmp_path, 4)
    assert [obs.state["arm/joints"].tolist() for obs in found] == [[0, 0], [5, 5], [100, 100], [105, 105]]
    assert [obs.gripper for obs in found] == [0, 1, 0, 1]
    assert [round(obs.cameras["front"].mean() / 20) for obs in found] == [0, 5, 0, 5]


def test_one_trajectory_gives_all_and_many_give_one_each(tmp_path: Path) -> None:
    record(tmp_path / "ep0.npz", 0.0)
    assert [obs.state["arm/joints"][0] for obs in recorded_observations(tmp_path, 3)] == [0, 2, 5]
    for number in range(1, 5):
        record(tmp_path / f"ep{number}.npz", 100.0 * number)
    assert len(recorded_observations(tmp_path, 3)) == 3


def test_a_file_brings_them_to_another_process(tmp_path: Path) -> None:
    record(tmp_path / "ep0.npz", 0.0)
    observations = recorded_observations(tmp_path, 3)
    observations[1].gripper = None
    save_observations(observations, tmp_path / "frames.npz")
    loaded = load_observations(tmp_path / "frames.npz")
    assert len(loaded) == 3
    for one, other in zip(loaded, observations, strict=True):
        assert one.gripper == other.gripper
        np.testing.assert_array_equal(one.state["arm/joints"], other.state["arm/joints"])
        np.testing.assert_array_equal(one.cameras["front"], other.cameras["front"])


def test_what_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no trajectory"):
        recorded_observations(tmp_path, 3)
    record(tmp_path / "ep0.npz", 0.0, frames=4)
    with pytest.raises(ConfigError, match=r"ep0_front\.mp4.*5"):
        recorded_observations(tmp_path, 3)
    (tmp_path / "ep0_front.mp4").unlink()
    with pytest.raises(ConfigError, match=r"ep0_front\.mp4"):
        recorded_observations(tmp_path, 3)
