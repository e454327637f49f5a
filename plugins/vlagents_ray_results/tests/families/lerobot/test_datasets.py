"""Tests in which LeRobot itself reads our datasets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import LINE
from in_process_evaluation import flat_config, play
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.rl.buffer import ReplayBuffer
from recorded_sessions import recorded, seen

from vlagents_ray.dataset_contract import BYTES, STATISTICS, DatasetContract
from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.interface import Obs
from vlagents_ray.robot.record import Recorder
from vlagents_ray_results.lerobot import to_lerobot


def test_lerobot_reads_what_an_evaluation_recorded(tmp_path: Path) -> None:
    options = {"envs": [LINE], "episodes": 3, "env_options": {"camera": [32, 48], "state_dim": 2}}
    results = play(flat_config(**options, record="all", video="none", out=tmp_path / "out"))
    to_lerobot(results, tmp_path / "dataset")
    dataset = LeRobotDataset("evaluation/line", root=tmp_path / "dataset")
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (3, 30, 10)
    frames = iter(dataset)
    for episode in results.cases[0].episodes:
        trajectory = Trajectory.load(results.out / str(episode.trajectory))
        for i in range(10):
            frame = next(frames)
            assert frame["action"].numpy().reshape(-1).tolist() == trajectory.actions[i].tolist()
            assert (
                frame["observation.state"].numpy().tolist()
                == trajectory.state["position"][i].tolist()
            )
            assert (
                frame["observation.state.position"].numpy().tolist()
                == trajectory.state["position"][i].tolist()
            )
            assert float(frame["next.reward"]) == np.float32(trajectory.rewards[i])
            assert bool(frame["next.success"]) == trajectory.success[i]
            assert bool(frame["next.done"]) == (i == 9)
            assert frame["task"] == episode.result.instruction
            image = frame["observation.images.front"]
            assert image.shape == (3, 32, 48)
            assert 255 * float(image[0].mean()) == pytest.approx(20 * i, abs=6)
    assert dataset.meta.stats["action"]["count"] == [30]
    assert dataset.meta.features["action"]["spec"]["dim"] == 1


def test_lerobots_tools_leave_out_episodes_and_merge_datasets_of_ours(tmp_path: Path) -> None:
    datasets = []
    for number, seed in enumerate((0, 10)):
        options = {
            "envs": [LINE],
            "episodes": 3,
            "seed": seed,
            "env_options": {"camera": [32, 48], "state_dim": 2},
        }
        results = play(
            flat_config(**options, record="all", video="none", out=tmp_path / f"out{number}")
        )
        to_lerobot(results, tmp_path / f"dataset{number}")
        datasets.append(
            LeRobotDataset(f"evaluation/line{number}", root=tmp_path / f"dataset{number}")
        )
    merged = merge_datasets(datasets, "evaluation/merged", tmp_path / "merged")
    assert merged.num_episodes == 6
    [own, both] = [
        DatasetContract.from_statistics(one.meta.stats[STATISTICS][BYTES])
        for one in (datasets[0], merged)
    ]
    assert own == both
    fewer = delete_episodes(datasets[0], [1], tmp_path / "fewer", "evaluation/fewer")
    assert fewer.num_episodes == 2
    assert fewer.meta.stats["observation.state.position"]["mean"].shape == (2,), (
        "by which the parts are told"
    )


def test_lerobot_reads_and_merges_what_a_server_recorded(tmp_path: Path) -> None:
    datasets, chunks = [], []
    for number in range(2):
        with recorded(tmp_path / f"traces{number}") as server:
            chunks += [server.robot().play(5, seed=seed) for seed in (1, 2)]
        [root] = (tmp_path / f"traces{number}").iterdir()
        datasets.append(LeRobotDataset(f"traces/{number}", root=root))
    dataset = datasets[0]
    assert (dataset.num_episodes, dataset.num_frames) == (2, 10)
    for i in range(5):
        frame = dataset[i]
        np.testing.assert_array_equal(frame["chunk"].numpy().reshape(4, 2), chunks[0][i])
        assert int(frame["chunk_rows"]) == 4
        assert frame["task"] == "stack the cups"
        image = (
            (255 * frame["observation.images.front"].numpy())
            .round()
            .astype(np.uint8)
            .transpose(1, 2, 0)
        )
        np.testing.assert_array_equal(image, seen(i).cameras["front"])
    merged = merge_datasets(datasets, "traces/merged", tmp_path / "merged")
    assert merged.num_episodes == 4
    np.testing.assert_array_equal(merged[15]["chunk"].numpy().reshape(4, 2), chunks[3][0])


def test_lerobot_reads_what_a_human_corrected(tmp_path: Path) -> None:
    with Recorder(tmp_path / "dataset", 10, interventions=True) as recorder:
        for label in ("success", "discard", "failure"):
            with recorder.episode("stack the cups"):
                for i in range(6):
                    camera = np.full((32, 48, 3), 20 * i, np.uint8)
                    obs = Obs({"front": camera}, state={"joints": np.full(3, i, np.float32)})
                    human = i >= 3
                    wanted = np.full(2, -i, np.float32) if i == 3 else None
                    recorder.add(
                        obs,
                        np.full(2, i, np.float32),
                        tick=i,
                        intervention=human,
                        policy_action=wanted,
                    )
                recorder.label(label)  # type: ignore[arg-type]
    dataset = LeRobotDataset("corrections/cups", root=tmp_path / "dataset")
    assert (dataset.num_episodes, dataset.num_frames) == (2, 12)
    frames = [dataset[i] for i in range(6)]
    assert [bool(frame["intervention"]) for frame in frames] == [False] * 3 + [True] * 3
    assert [bool(frame["policy_known"]) for frame in frames] == [True] * 4 + [False] * 2
    assert [frame["policy_action"].tolist() for frame in frames] == [
        [0, 0],
        [1, 1],
        [2, 2],
        [-3, -3],
        [0, 0],
        [0, 0],
    ]
    assert [frame["action"].tolist() for frame in frames] == [[i, i] for i in range(6)]
    assert list(dataset.meta.episodes["label"]) == ["success", "failure"]
    assert dataset.meta.stats["policy_action"]["count"] == [12]
    plain: dict[str, Any] = {
        "device": "cpu",
        "use_drq": False,
        "image_augmentation_function": lambda images: images,
    }
    buffer = ReplayBuffer.from_lerobot_dataset(dataset, state_keys=["observation.state"], **plain)
    assert buffer.rewards.tolist() == [0, 0, 0, 0, 0, 1, *[0] * 6], (
        "of HIL-SERL: the label is the reward"
    )
    assert buffer.dones.tolist() == [False] * 5 + [True] + [False] * 5 + [True]
    assert buffer.actions.tolist() == [[i, i] for i in range(6)] * 2, "those that were executed"
    assert buffer.next_states["observation.state"][:, 0].tolist() == [1, 2, 3, 4, 5, 5] * 2
    kept = delete_episodes(dataset, [1], tmp_path / "kept", "corrections/kept")
    assert [bool(kept[i]["intervention"]) for i in range(6)] == [False] * 3 + [True] * 3
