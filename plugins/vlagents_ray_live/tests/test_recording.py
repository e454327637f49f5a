"""Tests of the recording of sessions, also when the disk or the memory is full."""

from __future__ import annotations

import errno
import json
import shutil
import stat
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from eval_fakes import wait_for
from faulty_disks import FULL, python_on
from recorded_sessions import Brightness, recorded, reply_of, seen

from vlagents_ray.datasets.writer import Dataset
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget, Request
from vlagents_ray.protocol.values import from_text
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray_live import episodes, recording
from vlagents_ray_live.recording import SessionRecorder, Worker


def rows(root: Path, episode: int = 0) -> dict[str, list]:
    found: dict[str, list] = pq.read_table(
        root / f"data/chunk-000/file-{episode:03d}.parquet"
    ).to_pydict()
    return found


def pending(request: Request) -> Any:
    return SimpleNamespace(session_id="a", request=request, files={}, observer_data={})


def only(folder: Path) -> Path:
    [root] = folder.iterdir()
    return root


def test_each_act_is_a_frame_with_its_whole_chunk(tmp_path: Path) -> None:
    agent = Brightness()
    agent.weights_id = {"digest": "sampled-sha256:9f2c", "revision": "c0ffee"}
    folder = tmp_path / "traces"
    with recorded(folder, agent) as server:
        chunks = server.robot().play(5, seed=7)
    root = only(folder)
    frames = rows(root)
    assert frames["chunk"] == [chunk.ravel().tolist() for chunk in chunks]
    assert frames["action"] == [chunk[0].tolist() for chunk in chunks]
    assert frames["chunk_rows"] == [4] * 5
    assert frames["tick"] == [0, 1, 2, 3, 4]
    assert frames["captured_at"] == [1e9 + i for i in range(5)]
    assert frames["observation.state"] == [[i, -i, 0.5] for i in range(5)]
    assert frames["policy_version"] == [0] * 5
    assert all(ms > 0 for ms in frames["inference_ms"])
    budget = Budget(DEFAULT_LIMITS)
    assert [from_text(text, budget) for text in frames["request"]] == [
        {"offset": i / 4} for i in range(5)
    ]
    assert {from_text(text, budget)["subtask"] for text in frames["answer"]} == {"reach"}
    assert [from_text(text, budget) if text else None for text in frames["reset"]] == [
        {"seed": 7},
        *[None] * 4,
    ]
    acting = {"weights": "sampled-sha256:9f2c", "revision": "c0ffee"}  # the weights of this episode
    assert [from_text(text, budget) if text else None for text in frames["weights"]] == [
        acting,
        *[None] * 4,
    ]
    [file] = folder.rglob("*.mp4")
    with av.open(str(file)) as video:
        for i, frame in enumerate(video.decode(video=0)):
            np.testing.assert_array_equal(
                frame.to_ndarray(format="rgb24"), seen(i).cameras["front"]
            )
    info = json.loads((root / "meta/info.json").read_text())
    assert info["trace"]["policy"] == "brightness"
    assert info["vlagents_ray"]["contract"]["action"]["space"] == "joint"
    assert info["features"]["chunk"] == {"dtype": "float32", "shape": [8], "names": None}
    for private in (folder, root):
        assert stat.S_IMODE(private.stat().st_mode) == 0o700


def test_an_observation_is_copied_before_its_answer_is_kept(tmp_path: Path) -> None:
    with recorded(tmp_path) as server:
        robot = server.robot()
        robot.play(1)
        obs = seen(3)
        robot.act(obs)
        wait_for(server.recorder._copier._calls.empty)
        obs.cameras["front"][:] = 0  # the client may change its memory again
        obs.state["joints"][:] = 9
    assert rows(only(tmp_path))["observation.state"][1] == [3, -3, 0.5]


def test_sessions_at_once_have_episodes_of_their_own(tmp_path: Path) -> None:
    with recorded(tmp_path) as server:
        one, other = server.robot(), server.robot()
        one.play(1, seed=1, instruction="stack")
        other.play(1, seed=2, instruction="sort")
        for i in range(1, 4):
            one.act(seen(i))
            other.act(seen(10 + i))
    both = [rows(only(tmp_path), i) for i in range(2)]
    assert [one["tick"] for one in both] == [[0, 1, 2, 3]] * 2
    assert {one["session"][0]: one["observation.state"][2][0] for one in both} == {0: 2, 1: 12}
    assert not (only(tmp_path) / "unfinished").exists() or not any(
        (only(tmp_path) / "unfinished").iterdir()
    )


def test_other_cameras_go_into_a_dataset_of_their_own(tmp_path: Path) -> None:
    with recorded(tmp_path, pictures="small") as server:
        robot = server.robot()
        robot.play(1)
        robot.act(seen(1, side=64))
    names = sorted(tmp_path.iterdir())
    assert [name.name[-2:] for name in names] == ["-0", "-1"]
    assert [rows(name)["tick"] for name in names] == [[0], [1]]
    with av.open(str(next(tmp_path.rglob("*.mp4")))) as video:
        assert video.streams.video[0].codec_context.pix_fmt == "yuv420p", (
            "small ones are ordinary videos"
        )


def test_a_long_session_goes_on_in_the_next_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(episodes, "_FRAMES", 3)
    with recorded(tmp_path) as server:
        server.robot().play(7)
    frames = [rows(only(tmp_path), i) for i in range(3)]
    assert [one["tick"] for one in frames] == [[0, 1, 2], [3, 4, 5], [6]]
    assert [set(one["session"]) for one in frames] == [{0}] * 3


def test_an_act_that_failed_is_not_kept(tmp_path: Path) -> None:
    with recorded(tmp_path) as server:
        robot = server.robot()
        robot.play(1)
        failed = robot.ask(Request("act", Obs(seen(1).cameras, 0.5, seen(1).state, {"fail": True})))
        assert failed.error is not None
        robot.act(seen(2))
    assert rows(only(tmp_path))["tick"] == [0, 1]
    assert rows(only(tmp_path))["observation.state"][1][0] == 2


def test_shorter_chunks_are_filled_up_and_longer_ones_get_another_dataset(tmp_path: Path) -> None:
    with recorded(tmp_path) as server:
        robot = server.robot()
        chunks = robot.play(1)
        for number in (2, 6, 4):
            obs = seen(number)
            obs.info["rows"] = number
            chunks.append(robot.act(obs))
    first, second = sorted(tmp_path.iterdir())
    assert (rows(first)["chunk_rows"], rows(second)["chunk_rows"]) == ([4, 2], [6, 4])
    assert rows(first)["chunk"][1] == [*chunks[1].ravel().tolist(), *chunks[1][-1].tolist() * 2]
    assert rows(second)["chunk"][0] == chunks[2].ravel().tolist()


def test_a_share_of_the_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draws = iter([0.9, 0.1])
    monkeypatch.setattr(recording, "random", SimpleNamespace(random=lambda: next(draws)))
    with recorded(tmp_path, share=0.5) as server:
        server.robot().play(2, instruction="left out")
        server.robot().play(3, instruction="kept")
    tasks = pq.read_table(only(tmp_path) / "meta/tasks.parquet").to_pydict()
    assert tasks["__index_level_0__"] == ["kept"]


def test_a_session_that_ends_while_its_acts_wait_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()
    add = episodes.EpisodeWriter.add

    def slow(*args: Any) -> None:
        go_on.wait(10)
        add(*args)

    monkeypatch.setattr(episodes.EpisodeWriter, "add", slow)
    with recorded(tmp_path) as server:
        robot = server.robot()
        robot.play(5)
        robot.sender.release(for_good=True)
        wait_for(lambda: not server.engine.sessions.ids())
        go_on.set()
        wait_for(lambda: server.recorder.saved == 5)
        assert server.recorder.lost == 0


def test_a_time_that_is_no_number_is_that_of_the_arrival(tmp_path: Path) -> None:
    with recorded(tmp_path) as server:
        robot = server.robot()
        robot.play(1)
        robot.act(replace(seen(1), info={"captured_at": "noon"}))
    frames = rows(only(tmp_path))
    assert frames["captured_at"][1] == frames["received_at"][1]


def test_an_observation_that_cannot_be_kept_is_a_gap(tmp_path: Path) -> None:
    with recorded(tmp_path) as server:
        robot = server.robot()
        robot.play(1)
        # Only a caller in this process can send such an observation.
        robot.act(replace(seen(1), info={"object": object()}))
        robot.act(seen(2))
    assert rows(only(tmp_path))["tick"] == [0, 2]


def test_more_sessions_than_there_are_encoders_for_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(episodes, "_SESSIONS", 1)
    with recorded(tmp_path) as server:
        server.robot().play(2)
        server.robot().play(3)
        wait_for(lambda: server.recorder.lost == 3)
    assert len(rows(only(tmp_path))["tick"]) == 2


@pytest.mark.parametrize(
    ("room", "obs", "kept"),
    [
        (
            2 * recording._OTHER_BYTES,
            Obs(state={"joints": np.zeros(2, np.float32)}),
            [True, True, False],
        ),
        (10**6, Obs(info={"a": [{"b": bytes(600_000)}], "c": np.zeros(10)}), [True, False, False]),
    ],
    ids=["without pictures", "bytes beside pictures"],
)
def test_requests_that_wait_are_bounded(
    tmp_path: Path, room: int, obs: Obs, kept: list[bool]
) -> None:
    with recorded(tmp_path) as server:
        server.recorder._held_bytes = room
        waiting = [pending(Request("act", obs)) for _ in range(3)]
        for one in waiting:
            server.recorder.on_request(one)
        assert [bool(one.observer_data) for one in waiting] == kept
        del one, waiting
        # The memory is freed, as no thread needs it any more.
        wait_for(lambda: server.recorder._held == 0)


def test_what_does_not_fit_into_memory_is_dropped_and_counted(tmp_path: Path) -> None:
    with recorded(tmp_path) as server:
        robot = server.robot()
        robot.play(1)
        wait_for(lambda: server.recorder._held == 0)
        server.recorder._held_bytes = 10
        robot.act(seen(1))
        server.recorder._held_bytes = 10**6
        robot.act(seen(2))
        assert server.recorder.lost == 1
    assert rows(only(tmp_path))["tick"] == [0, 2]


def test_a_full_folder_ends_the_recording_and_no_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(episodes, "_CHECK_S", 0.0)
    with recorded(tmp_path, most_gb=1e-9) as server:
        robot = server.robot()
        robot.play(2)
        robot.play(1)
        wait_for(lambda: server.recorder.ended is not None)
        assert "GB" in str(server.recorder.ended)
        assert robot.act(seen(2)).shape == (4, 2)
    assert len(rows(only(tmp_path))["tick"]) == 2, "what was recorded before is complete"


@pytest.mark.parametrize("full", [True, False], ids=["full", "nearly full"])
def test_a_full_disk_ends_the_recording_and_no_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, full: bool
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    if full:
        monkeypatch.setattr(Dataset, "save", fail)
    else:
        usage = shutil.disk_usage(tmp_path)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10))
    with recorded(tmp_path) as server:
        robot = server.robot()
        robot.play(2)
        robot.play(2)
        wait_for(lambda: server.recorder.ended is not None)
        assert robot.act(seen(2)).shape == (4, 2)
        assert server.recorder.lost >= 2 or not full


RECORD_AT_EACH_WRITE = """
import json, logging, sys
from pathlib import Path
from faulty_disks import at_each_write
from recorded_sessions import recorded
from vlagents_ray.errors import ConfigError, StorageFailed
from vlagents_ray_live import episodes
episodes._FREE_BYTES = 0

class Messages(logging.Handler):
    def emit(self, record):
        messages.append(record.getMessage())

messages = []
logging.getLogger("vlagents_ray_live").addHandler(Messages())

def write(root):
    messages.clear()
    try:
        with recorded(root, pictures="small") as server:
            robot = server.robot()
            robot.play(3, seed=1)
            robot.play(3, seed=2)
    except ConfigError as error:
        raise StorageFailed(str(error)) from error
    if messages:
        raise StorageFailed(messages[0])
    assert server.recorder.lost == 0

def check(root):
    infos = [json.loads(path.read_text()) for path in root.glob("*/meta/info.json")]
    assert sum(info["total_episodes"] for info in infos) >= 2, infos

print("failed writes:", at_each_write(Path(sys.argv[1]), write, check))
"""


@pytest.mark.hosts
def test_a_disk_that_fills_at_any_write_ends_the_recording_with_one_sentence(
    tmp_path: Path,
) -> None:
    done = python_on(FULL, tmp_path, RECORD_AT_EACH_WRITE, size="4m,nr_inodes=400")
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.splitlines()[-1].removeprefix("failed writes: ")) > 20


def test_a_folder_that_cannot_be_written_to_is_told_at_the_start(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"parts\.record\.folder"), recorded(tmp_path / "file"):
        pass


@pytest.mark.parametrize("part", ["record", "live"])
def test_a_relative_folder_is_one_of_the_process_that_starts_the_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    monkeypatch.chdir(tmp_path)
    [application] = deployment("noop", parts={part: {"folder": "kept"}}).applications
    assert application.args["parts"] == {part: {"folder": str(tmp_path / "kept")}}


def test_two_recorders_see_the_same(tmp_path: Path) -> None:
    with recorded(tmp_path / "one") as server:
        second = SessionRecorder(
            episodes.EpisodeWriter(tmp_path / "two", "second", 10, lossless=True, most_bytes=1e9),
            server.engine.sessions,
        )
        others = server.engine.observers
        others.add(second)
        server.robot().play(2)
        others.remove(second)
        reply_of(server.robot().ask(Request("reset", seen(0), "alone")))
        second.close()
    one, two = only(tmp_path / "one"), only(tmp_path / "two")
    assert rows(one)["chunk"] == rows(two)["chunk"]


def test_a_worker_goes_on_after_an_error_and_makes_the_calls_that_wait_before_it_ends() -> None:
    worker, made, go_on = Worker("test"), list[int](), threading.Event()

    def wait() -> None:
        assert go_on.wait(10)
        made.append(1)

    worker.put(wait)
    worker.put(lambda: made.append(1 // 0))
    worker.put(lambda: made.append(3))
    go_on.set()
    worker.close(10)
    assert made == [1, 3]
