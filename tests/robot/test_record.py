"""Recordings in LeRobot's format: observations and actions are kept, whatever happens to the disk
or the process.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from eval_fakes import wait_for
from faulty_disks import FULL, python_on

from vlagents_ray import ConfigError, Obs
from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.dataset_contract import BYTES, INFO, STATISTICS, DatasetContract
from vlagents_ray.datasets.writer import Dataset
from vlagents_ray.errors import InvalidObservation, StorageFailed
from vlagents_ray.robot import record as record_module
from vlagents_ray.robot.record import Recorder

FPS = 25
SIDE = 48
VIDEO = "videos/observation.images.front/chunk-000"


def obs(i: int, side: int = SIDE) -> Obs:
    state = {"joints": np.array([i, -i], np.float32), "left/force": np.array([0.5])}
    cameras = {
        "front": np.full((side, side, 3), 10 * i % 256, np.uint8),
        "left/wrist": np.zeros((33, 47, 3), np.uint8),
    }
    return Obs(cameras, 0.25, state, {"captured_at": 1e9 + i / FPS})


def action(i: int) -> np.ndarray:
    return np.array([i, i + 0.5, 1], np.float32)


def record(root: Path, frames: int, instruction: str = "stack the cups") -> None:
    with Recorder(root, FPS, frames=1000) as recorder, recorder.episode(instruction):
        for i in range(frames):
            recorder.add(obs(i), action(i), tick=2 * i, safe=i == 3)


def info(root: Path) -> dict:
    return json.loads((root / "meta/info.json").read_text())


def test_two_cameras_never_share_a_video(tmp_path: Path) -> None:
    for _ in range(2):  # the second round opens the dataset again
        with Recorder(tmp_path, FPS) as recorder, recorder.episode("look"):
            for i in range(4):
                views = {"left/wrist": 0, "left_wrist": 200, "front": 100}
                cameras = {
                    name: np.full((SIDE, SIDE, 3), value, np.uint8) for name, value in views.items()
                }
                recorder.add(Obs(cameras), action(i), tick=i)
    seen = {}
    for path in tmp_path.rglob("file-001.mp4"):
        with av.open(str(path)) as video:
            frames = [
                round(float(frame.to_ndarray(format="rgb24").mean()), -1)
                for frame in video.decode(video=0)
            ]
        seen[path.parent.parent.name.rpartition(".")[2]] = frames
    assert seen == {"left_wrist": [200] * 4, "left_wrist_2": [0] * 4, "front": [100] * 4}


def test_a_policy_that_is_trained_on_it_learns_what_its_state_and_cameras_are(
    tmp_path: Path,
) -> None:
    for _ in range(2):  # the second round opens the dataset again
        record(tmp_path, 3)
    about = DatasetContract.from_json(info(tmp_path)[INFO])
    assert about.state == ("joints", "left/force", "gripper")
    assert about.cameras == {
        "observation.images.front": "front",
        "observation.images.left_wrist": "left/wrist",
    }
    assert about.contract == Contract(
        cameras={"front": CameraSpec(SIDE, SIDE), "left/wrist": CameraSpec(33, 47)},
        state={"joints": StateSpec(2), "left/force": StateSpec(1)},
        gripper=True,
        action=ActionSpec(dim=3),
        control_hz=FPS,
    )
    statistics = json.loads((tmp_path / "meta/stats.json").read_text())
    assert DatasetContract.from_statistics(statistics[STATISTICS][BYTES]) == about
    assert statistics["action"]["count"] == [6]


def test_the_gripper_is_that_of_the_observation(tmp_path: Path) -> None:
    seen = Obs(
        gripper=0.5,
        state={"gripper": np.array([0.04], np.float32), "joints": np.zeros(2, np.float32)},
    )
    with Recorder(tmp_path, FPS) as recorder, recorder.episode("grasp"):
        recorder.add(seen, action(0), tick=0)
    rows = pq.read_table(tmp_path / "data/chunk-000/file-000.parquet").to_pydict()
    assert rows["observation.state"] == [[0, 0, 0.5]]
    assert DatasetContract.from_json(info(tmp_path)[INFO]).state == ("joints", "gripper")


def test_an_episode_holds_what_was_seen_and_done(tmp_path: Path) -> None:
    record(tmp_path, 12)
    rows = pq.read_table(tmp_path / "data/chunk-000/file-000.parquet").to_pydict()
    assert rows["action"] == [action(i).tolist() for i in range(12)]
    assert rows["observation.state"] == [[i, -i, 0.5, 0.25] for i in range(12)]
    assert rows["tick"] == [2 * i for i in range(12)]
    assert rows["safe"] == [i == 3 for i in range(12)]
    assert rows["captured_at"] == [1e9 + i / FPS for i in range(12)]
    assert rows["timestamp"] == pytest.approx([i / FPS for i in range(12)])
    with av.open(str(tmp_path / "videos/observation.images.front/chunk-000/file-000.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert [round(float(frame.mean()) / 10) for frame in frames] == list(range(12))
    about = info(tmp_path)
    assert about["codebase_version"] == "v3.0"
    assert (about["total_episodes"], about["total_frames"], about["total_tasks"], about["fps"]) == (
        1,
        12,
        1,
        FPS,
    )
    features = about["features"]
    assert features["observation.state"]["names"] == [
        "joints_0",
        "joints_1",
        "left/force_0",
        "gripper",
    ]
    # rounded up to even numbers
    assert features["observation.images.left_wrist"]["shape"] == [34, 48, 3]
    assert not (tmp_path / "unfinished").exists() or not any((tmp_path / "unfinished").iterdir())


def test_a_dataset_goes_on_with_the_next_episode(tmp_path: Path) -> None:
    record(tmp_path, 5)
    record(tmp_path, 7, "unstack the cups")
    record(tmp_path, 3)
    rows = [
        pq.read_table(tmp_path / f"data/chunk-000/file-{i:03d}.parquet").to_pydict()
        for i in range(3)
    ]
    assert [row["episode_index"][0] for row in rows] == [0, 1, 2]
    assert [row["task_index"][0] for row in rows] == [0, 1, 0]
    assert [row["index"] for row in rows] == [
        list(range(5)),
        list(range(5, 12)),
        list(range(12, 15)),
    ]
    episode = pq.read_table(tmp_path / "meta/episodes/chunk-000/file-001.parquet").to_pylist()[0]
    assert episode["tasks"] == ["unstack the cups"]
    assert (episode["dataset_from_index"], episode["dataset_to_index"]) == (5, 12)
    assert info(tmp_path)["splits"] == {"train": "0:3"}


def test_statistics_are_those_of_all_frames(tmp_path: Path) -> None:
    record(tmp_path, 5)
    record(tmp_path, 9)
    told = json.loads((tmp_path / "meta/stats.json").read_text())
    values = np.stack([action(i) for i in [*range(5), *range(9)]])
    for name, expected in (
        ("mean", values.mean(0)),
        ("std", values.std(0)),
        ("max", values.max(0)),
        ("count", [14]),
    ):
        assert told["action"][name] == pytest.approx(expected), name
    seen = np.array([10 * i for i in [*range(5), *range(9)]]) / 255
    image = {name: np.ravel(value) for name, value in told["observation.images.front"].items()}
    assert image["mean"] == pytest.approx([seen.mean()] * 3)
    assert image["std"] == pytest.approx([seen.std()] * 3)
    assert (image["min"][0], image["max"][0]) == pytest.approx((0, 80 / 255))


def test_adding_never_waits_and_what_is_dropped_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    going, gate = threading.Event(), threading.Event()
    begin = Dataset.begin

    def slow(self: Dataset, instruction: str) -> object:
        going.set()
        assert gate.wait(30)
        return begin(self, instruction)

    monkeypatch.setattr(Dataset, "begin", slow)
    with Recorder(tmp_path, FPS, frames=4) as recorder, recorder.episode("stack"):
        assert going.wait(30)
        for i in range(10):
            recorder.add(obs(i), action(i), tick=i)
        assert recorder.dropped == 6
        gate.set()
    assert pq.read_table(tmp_path / "data/chunk-000/file-000.parquet")["tick"].to_pylist() == [
        0,
        1,
        2,
        3,
    ]


def test_a_frame_is_recorded_as_it_was_when_it_was_added(tmp_path: Path) -> None:
    seen, done = obs(1), action(1)
    with Recorder(tmp_path, FPS) as recorder, recorder.episode("stack"):
        recorder.add(seen, done, tick=0)
        seen.state["joints"][:] = 99
        done[:] = 99
    rows = pq.read_table(tmp_path / "data/chunk-000/file-000.parquet").to_pydict()
    assert (rows["observation.state"][0][0], rows["action"][0][0]) == (1, 1)


def test_a_frame_unlike_the_first_costs_its_episode_and_is_told(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, FPS)
    for side in (SIDE, 2 * SIDE, SIDE):
        with recorder.episode("stack"):
            recorder.add(obs(0), action(0), tick=0)
            recorder.add(obs(1, side), action(1), tick=1)
    with pytest.raises(InvalidObservation, match=r"expected .* as before"):
        recorder.close()
    assert info(tmp_path)["total_episodes"] == 2


def test_a_full_disk_costs_its_episode_and_no_later_one(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    recorder = Recorder(tmp_path, FPS, frames=1000)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    # A file that grows longer cannot be written.
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
    try:
        with recorder.episode("stack"):
            for i in range(100):
                camera = noise.integers(0, 255, (2 * SIDE, 2 * SIDE, 3), np.uint8)
                recorder.add(Obs({"front": camera}), action(i), tick=i)
        wait_for(lambda: recorder.error is not None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    with recorder.episode("stack"):
        recorder.add(obs(0), action(0), tick=0)
    with pytest.raises(StorageFailed, match=r"too large.*kept: 1, frames of others lost: 100;"):
        recorder.close()
    assert info(tmp_path)["total_episodes"] == 1


RECORD_AT_EACH_WRITE = """
import json, sys
from pathlib import Path
import numpy as np
from faulty_disks import at_each_write
from vlagents_ray import Obs
from vlagents_ray.robot import record
from vlagents_ray.robot.record import Recorder
record.LEAST_FREE_BYTES = 0

def write(root):
    with Recorder(root, 25, frames=100) as recorder:
        for task in ("stack", "unstack"):
            with recorder.episode(task):
                for tick in range(4):
                    camera = np.full((32, 32, 3), 50 * tick, np.uint8)
                    recorder.add(Obs({"front": camera}), np.zeros(2, np.float32), tick=tick)

def check(root):
    info = json.loads((root / "meta/info.json").read_text())
    counted = info["total_episodes"]
    assert counted >= 2, counted
    for folder in ("data", "videos/observation.images.front", "meta/episodes"):
        files = sorted(path.name[:8] for path in (root / folder).glob("*/*"))
        assert files == [f"file-{number:03d}" for number in range(counted)], (folder, files)
    assert not (root / "unfinished").exists()

print("failed writes:", at_each_write(Path(sys.argv[1]), write, check))
"""


@pytest.mark.hosts
def test_a_disk_that_fills_at_any_write_costs_one_episode_and_no_later_one(tmp_path: Path) -> None:
    done = python_on(FULL, tmp_path, RECORD_AT_EACH_WRITE, size="4m,nr_inodes=400")
    assert done.returncode == 0, done.stderr
    [line] = done.stdout.splitlines()
    assert int(line.removeprefix("failed writes: ")) > 20


def test_a_recording_does_not_begin_without_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record_module, "LEAST_FREE_BYTES", 1e18)
    with pytest.raises(StorageFailed, match=r"at least 1e\+12 MB of free .*, got .*; make room"):
        Recorder(tmp_path / "new" / "dataset", FPS)
    assert not (tmp_path / "new").exists()


def test_a_killed_process_loses_the_running_episode_and_no_other(tmp_path: Path) -> None:
    code = f"""
import contextlib, os, pathlib, signal, sys, time
import numpy as np
from vlagents_ray import Obs
from vlagents_ray.robot.record import Recorder
recorder = Recorder(pathlib.Path({str(tmp_path)!r}), {FPS}, frames=1000)
for episode in range(3):
    with recorder.episode("stack"):
        for i in range(6):
            recorder.add(Obs({{"front": np.zeros((48, 48, 3), np.uint8)}}), np.zeros(2, np.float32), tick=i)
        while episode == 2:  # killed in the third
            with contextlib.suppress(FileNotFoundError):  # a folder that was finished during the search
                if list(pathlib.Path({str(tmp_path)!r}).glob("unfinished/*/*.mp4")) and recorder.episodes == 2:
                    print("recording", flush=True)
                    time.sleep(60)
            time.sleep(0.01)
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "recording\n"
        os.kill(process.pid, signal.SIGKILL)
    assert info(tmp_path)["total_episodes"] == 2
    assert len(list(tmp_path.glob("data/*/*.parquet"))) == 2
    strays = [
        tmp_path / f"{part}/file-002.{end}"
        for part, end in (("data/chunk-000", "parquet"), (VIDEO, "mp4"))
    ]
    for stray in strays:
        stray.write_bytes(b"whole, but of an episode that was not counted")
    assert Dataset(tmp_path, FPS).episodes == 2
    assert not any(stray.exists() for stray in strays)
    assert not (tmp_path / "unfinished").exists()


@pytest.mark.slow
def test_a_kill_at_any_moment_of_a_save_leaves_nothing_of_its_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, expected = tmp_path / "dataset", tmp_path / "expected"
    killed: list[Path] = []
    move = Dataset._move

    def moved(self: Dataset, part: Path, path: Path) -> None:
        killed.append(tmp_path / f"killed-{len(killed)}")
        shutil.copytree(root, killed[-1])
        move(self, part, path)

    record(root, 5)
    record(expected, 5)
    record(expected, 7, "stack the plates")
    with monkeypatch.context() as patched:
        patched.setattr(Dataset, "_move", moved)
        record(root, 9, "unstack the cups")
    assert (
        killed[-1].joinpath("meta/stats.json").read_bytes()
        != killed[0].joinpath("meta/stats.json").read_bytes()
    )
    for left in killed:
        record(left, 7, "stack the plates")
        for name in ("meta/info.json", "meta/stats.json"):
            assert json.loads((left / name).read_text()) == json.loads(
                (expected / name).read_text()
            ), (left, name)
        for name in ("meta/tasks.parquet", "data/chunk-000/file-001.parquet"):
            assert pq.read_table(left / name) == pq.read_table(expected / name), (left, name)


def test_a_folder_is_taken_only_as_an_empty_one_or_a_dataset_of_this_rate(tmp_path: Path) -> None:
    record(tmp_path, 0)
    assert not (tmp_path / "meta").exists(), "an episode without frames leaves nothing"
    record(tmp_path, 2)
    with pytest.raises(ConfigError, match="expected fps 50, got 25"):
        Recorder(tmp_path, 50)
    (tmp_path / "else").mkdir()
    (tmp_path / "else/thesis.tex").write_text("...")
    with pytest.raises(ConfigError, match="not a LeRobotDataset"):
        Recorder(tmp_path / "else", FPS)
