"""Tests that read an evaluation with the trackers' own readers, offline."""

from __future__ import annotations

import json
import logging
import os
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
import pytest
from eval_fakes import LINE, wait_for
from in_process_evaluation import flat_config, play
from served_agents import Proportional

from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.trackers import TrackerFeed
from vlagents_ray_learn import TrainingEvaluation

pytestmark = pytest.mark.torch

Config = Callable[..., EvalConfig]


@pytest.fixture
def told(config: Config) -> Callable[..., Results]:
    """Return a function that runs an evaluation, sends it to a tracker, and sends it again, as if
    it were resumed.
    """

    def tell(tracker: str, **changes: Any) -> Results:
        options = {"episodes": 3, "video": "all", "env_options": {"camera": [32, 32]}} | changes
        settings = config(track=[tracker], tracking={"project": "tests"}, **options)
        results = play(settings)
        for _ in range(2):
            with TrackerFeed(resolve(settings)) as tracking:
                tracking.update()
        return results

    return tell


WANDB_HEADER, LOG_BLOCK = 7, 32768


def rates(results: Results) -> list[float]:
    return [sum(bool(one.success_once) for one in case.counted) / 3 for case in results.cases]


@pytest.fixture(scope="module", autouse=True)
def _no_service_left() -> Iterator[None]:
    """End wandb's process, which would otherwise live as long as this process, and so during other
    tests.
    """
    yield
    import wandb

    wandb.teardown()
    wait_for(lambda: not wandb_processes())


def wandb_processes() -> list[str]:
    found = []
    for child in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):
            found.append(child.name())
    return [name for name in found if "wandb" in name]


def test_wandb_keeps_curves_videos_config_and_code(
    told: Callable[..., Results], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    results = told("wandb", steps=[10, 20])
    assert not [one for one in caplog.records if one.levelno >= logging.WARNING]
    read = read_wandb(results.out)
    name = f"{LINE}/success_once"
    points = [(row["training_step"], row[name]) for row in read.rows if name in row]
    assert points == list(zip([10, 20], rates(results), strict=True))
    assert [row["training_step"] for row in read.rows if "total/return" in row] == [10, 20]
    assert read.config["evaluation"]["suites"][0]["episodes"] == 3
    assert set(read.config["code"]) == {"folder", "vlagents_ray", "policy policy", f"env {LINE}"}
    assert [len(files) for kind, files in read.artifacts if kind == "videos"] == [3, 3]


@dataclass
class ReadRun:
    rows: list[dict[str, Any]] = field(default_factory=list)
    config: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)
    # The type and the files of each artifact.
    artifacts: list[tuple[str, list[str]]] = field(default_factory=list)


def read_wandb(out: Path) -> ReadRun:
    read, files = ReadRun(), list(out.glob("wandb/offline-run-*/*.wandb"))
    # wandb's own process writes the files, and may have more to write when `finish` returns.
    wait_for(lambda: all(records[-1].HasField("exit") for records in map(wandb_records, files)))
    for record in [one for file in sorted(files) for one in wandb_records(file)]:
        if record.HasField("history"):
            items = record.history.item
            read.rows.append(
                {
                    item.key or "/".join(item.nested_key): json.loads(item.value_json)
                    for item in items
                }
            )
        for update in [*record.run.config.update, *record.config.update]:
            read.config[update.key or update.nested_key[0]] = json.loads(update.value_json)
        for update in record.summary.update:
            read.summary[update.key or update.nested_key[0]] = json.loads(update.value_json)
        for artifact in [record.artifact] if record.HasField("artifact") else []:
            read.artifacts.append(
                (artifact.type, [entry.path for entry in artifact.manifest.contents])
            )
    return read


def wandb_records(file: Path) -> list[Any]:
    from wandb.proto.wandb_internal_pb2 import Record

    return [Record.FromString(data) for data in log_records(file.read_bytes()[WANDB_HEADER:])] or [
        Record()
    ]


def log_records(log: bytes) -> Iterator[bytes]:
    """Yield the records of a file in LevelDB's log format. A record may be in several pieces, and
    no piece crosses the end of a block.
    """
    at, record = 0, b""
    while at + 7 <= len(log):
        if (left := LOG_BLOCK - (at + WANDB_HEADER) % LOG_BLOCK) < 7:
            at += left
            continue
        length, kind = struct.unpack_from("<HB", log, at + 4)
        if at + 7 + length > len(log):  # the piece has not been written to its end yet
            return
        record += log[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # a whole record, or its last piece
            yield record
            record = b""


def test_wandb_keeps_a_policy_without_steps_in_the_summary(
    told: Callable[..., Results], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    results = told("wandb")
    read = read_wandb(results.out)
    assert read.rows == []
    assert read.summary["total/success_once"] == rates(results)[0]


def test_trackio_keeps_curves_and_videos(
    told: Callable[..., Results],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    import trackio
    from trackio.sqlite_storage import SQLiteStorage

    results = told("trackio", steps=[10, 20])
    assert not [one for one in caplog.records if one.levelno >= logging.WARNING]
    [run] = trackio.Api().runs("tests")
    logs = SQLiteStorage.get_logs("tests", run.name)
    points = [
        (row["step"], row[f"{LINE}/success_once"]) for row in logs if f"{LINE}/success_once" in row
    ]
    assert points == list(zip([10, 20], rates(results), strict=True))
    assert [row["step"] for row in logs if "total/return" in row] == [10, 20]
    assert len(list((tmp_path / "trackio").rglob("*.mp4"))) == 6
    assert run.config["evaluation"]["suites"][0]["episodes"] == 3


def test_trackio_shows_the_versions_of_a_learner_as_one_curve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    import trackio

    agent = Proportional()
    agent.initialize()
    plan = flat_config(
        envs=[LINE], episodes=4, video="none", policy="reach", out=tmp_path / "out",
        track=["trackio"], tracking={"project": "learning"},
    )  # fmt: skip
    evaluation = TrainingEvaluation(agent, plan)
    for version, gain in ((1, 0.1), (20, 1.0)):
        agent.tree["gain"][:] = gain
        evaluation.play(version)

    assert not [record for record in caplog.records if record.name == TrackerFeed.__module__]
    [run] = trackio.Api().runs("learning")
    assert run.name.startswith("reach-")
    assert curve("learning", run.name, f"{LINE}/success_once") == [(1, 0.0), (20, 1.0)]


def curve(project: str, run: str, name: str) -> list[tuple[int, float]]:
    """Return the steps and values of a metric, from Trackio's database in TRACKIO_DIR."""
    from trackio.sqlite_storage import SQLiteStorage

    logs = SQLiteStorage.get_logs(project, run)
    return [(row["step"], row[name]) for row in logs if name in row]


DASHBOARD = """
import sys
import threading

import trackio

urls = trackio.show(open_browser=False, block_thread=False, host="127.0.0.1")
print("ready", urls[-1], flush=True)
sys.stdin.read()
"""


@contextmanager
def trackio_server(folder: Path) -> Iterator[str]:
    """Run a server of Trackio on the loopback address, which stores runs in `folder`, and yield the
    URL at which it accepts them.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", DASHBOARD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TRACKIO_DIR": str(folder), "HF_HUB_OFFLINE": "1"},
    )
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if line.startswith("ready "):
                yield line.split()[1]
                break
        else:
            pytest.fail("the server of Trackio ended")
    finally:
        process.kill()
        process.communicate()


def test_trackio_sends_to_a_server_of_the_lab(
    told: Callable[..., Results],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with trackio_server(tmp_path / "server") as url:
        monkeypatch.setenv("TRACKIO_SERVER_URL", url)
        monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "client"))
        results = told("trackio", steps=[10, 20], video="none")
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]

    [database] = (tmp_path / "server").glob("*.db")
    with closing(sqlite3.connect(database)) as db:
        rows = db.execute("SELECT step, metrics FROM metrics ORDER BY step, id").fetchall()
    name = f"{LINE}/success_once"
    logged = [(step, json.loads(metrics)) for step, metrics in rows]
    points = [(step, metrics[name]) for step, metrics in logged if name in metrics]
    assert points == list(zip([10, 20], rates(results), strict=True))


def test_tensorboard_reads_the_curves_and_the_config(
    told: Callable[..., Results], caplog: pytest.LogCaptureFixture
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    results = told("tensorboard", steps=[10, 20])
    assert not [one for one in caplog.records if one.levelno >= logging.WARNING]
    found = EventAccumulator(str(results.out / "tensorboard" / "policy"))
    found.Reload()
    points = [(one.step, one.value) for one in found.Scalars(f"{LINE}/success_once")]
    assert points == [
        (step, pytest.approx(rate)) for step, rate in zip([10, 20], rates(results), strict=True)
    ]
    assert [one.step for one in found.Scalars("total/return")] == [10, 20]
    [config] = [one.tensor_proto.string_val[0].decode() for one in found.Tensors("config")]
    assert '"episodes": 3' in config
    [first, _] = [
        one.tensor_proto.string_val[0].decode() for one in found.Tensors(f"{LINE}/videos")
    ]
    assert len(first.splitlines()) == 3
