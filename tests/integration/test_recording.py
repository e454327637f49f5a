"""Recordings of sessions over all transports, and the recordings that remain after a replica is
killed.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from eval_fakes import wait_for
from prometheus_series import scrape
from recorded_sessions import seen
from typer.testing import CliRunner

from tests.integration.conftest import serving
from vlagents_ray import RemoteAgent
from vlagents_ray.cli.main import app
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.serve.launch.server import Server

POLICY = "recorded_sessions:Brightness"
TRANSPORTS: list[TransportName] = ["shm", "plasma", "handle", "websocket", "http"]
ACTS = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recorded") / "traces"


@pytest.fixture(scope="module")
def server(shared_ray: None, folder: Path) -> Iterator[Server]:
    with serving(POLICY, parts={"record": {"folder": str(folder)}}) as server:
        yield server


def saved(folder: Path) -> int:
    return sum(
        json.loads(path.read_text())["total_episodes"] for path in folder.glob("*/meta/info.json")
    )


def series(key: str) -> list[float]:
    found = [one for one in scrape() if one.tags.get("application") == "Brightness"]
    return [one.value for one in found if one.key("outcome") == key]


def play(agent: RemoteAgent, seed: int) -> tuple[int, list[np.ndarray]]:
    agent.reset(seen(0), "stack", seed=seed)
    acts = [agent.act(seen(i)) for i in range(ACTS)]
    return acts[0].info["pid"], [act.rows() for act in acts]


def test_sessions_of_every_transport_are_recorded_and_replayed_without_error(
    server: Server, folder: Path, tmp_path: Path
) -> None:
    chunks = {}
    for number, transport in enumerate(TRANSPORTS):
        url = "serve://Brightness" if transport in ("plasma", "handle") else server.url
        with RemoteAgent(url, transport=transport, codec="exact") as agent:
            chunks[number] = play(agent, number)[1]
    wait_for(lambda: saved(folder) == len(TRANSPORTS))
    files = sorted(folder.rglob("data/*/*.parquet"))
    recorded = [pq.read_table(file, columns=["chunk"]).to_pydict()["chunk"] for file in files]
    wanted = [[chunk.ravel().tolist() for chunk in one] for one in chunks.values()]
    assert sorted(recorded) == sorted(wanted)
    given = ["open-loop", str(folder), "--policy", POLICY, "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, given)
    assert done.exit_code == 0, done.output
    result = json.loads((tmp_path / "out/open_loop.json").read_text())
    assert (result["max"], result["frames"]) == (0.0, ACTS * len(TRANSPORTS))
    wait_for(
        lambda: series("vlagents_recorded_frames_total outcome=saved") == [ACTS * len(TRANSPORTS)]
    )
    assert series("vlagents_recording") == [1]


def test_a_killed_replica_loses_its_running_episodes_and_no_others(
    server: Server, folder: Path
) -> None:
    before = saved(folder)
    with RemoteAgent(server.url) as agent:
        play(agent, 1)
        pid, _ = play(agent, 2)  # this completes the recording of the first session
        wait_for(lambda: saved(folder) == before + 1)
        os.kill(pid, signal.SIGKILL)
        until = time.monotonic() + 60
        while agent.act(seen(7)).info["pid"] == pid and time.monotonic() < until:
            time.sleep(0.1)
    wait_for(lambda: saved(folder) == before + 2, timeout_s=30)
    assert len(list(folder.glob("*/meta/info.json"))) == 2, "the new replica has a separate dataset"
