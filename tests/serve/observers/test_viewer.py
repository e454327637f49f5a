"""Recordings of a server's sessions for Rerun."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from eval_fakes import wait_for
from live_server import LiveServer, live_server
from observed import observe
from rerun_files import read_rrd

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.errors import UnknownSession
from vlagents_ray.images.jpeg_png import decode
from vlagents_ray.interface import Act, Agent
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.observers.viewer import SessionViewer

ROWS = 3


class Counting(Agent):
    """Chunks whose rows all have the number of the act."""

    acts = 0

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        return Act(np.full((ROWS, 2), self.acts, np.float32))


def obs(value: int) -> Obs:
    return Obs({"front": np.full((16, 16, 3), value, np.uint8)}, 0.5, {"joints": np.full(3, value, np.float32)})


@contextmanager
def recorded(server: LiveServer, folder: Path) -> Iterator[None]:
    viewer = SessionViewer(server.engine.sessions, server.view.live, str(folder))
    try:
        wait_for(lambda: server.engine.observers.any)
        yield
    finally:
        viewer.close()


@pytest.mark.library("rerun")
def test_each_reset_of_a_session_begins_a_file_with_every_answer(tmp_path: Path) -> None:
    with (
        live_server(Counting()) as server,
        recorded(server, tmp_path),
        RemoteAgent(server.url, transport="http", codec="jpeg") as agent,
    ):
        for number, instruction in enumerate(("stack", "sort"), 1):
            agent.reset(obs(80), instruction)
            wait_for(lambda number=number: len(list(tmp_path.glob("*.rrd"))) == number)
            for _ in range(5):
                agent.act(obs(80))
    first, second = sorted(tmp_path.glob("*.rrd"))
    for file, instruction in ((first, "stack"), (second, "sort")):
        shown = read_rrd(file)
        assert shown["instruction"] == {None: instruction}
        chunks = {tick: [[tick + 1] * 2] * ROWS for tick in range(5)}
        assert shown["action/chunk"] == chunks
        assert shown["action/planned"] == {tick: rows[0] for tick, rows in chunks.items()}
        assert set(shown["timing/inference_ms"]) >= set(range(5))
    shown = read_rrd(first)
    assert {tuple(values) for values in shown["state/joints"].values()} == {(80.0, 80.0, 80.0)}
    pictures = list(shown["cameras/front"].values())
    assert all(data[:3] == b"\xff\xd8\xff" for data in pictures)
    assert {round(float(decode(data).mean()), -1) for data in pictures} == {80}


@pytest.mark.library("rerun")
def test_a_folder_that_cannot_be_written_to_costs_the_recording_and_no_answer(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "gone"
    with live_server(Counting()) as server, recorded(server, folder), caplog.at_level(logging.WARNING):
        folder.rmdir()
        with RemoteAgent(server.url, transport="http") as agent:
            agent.reset(obs(0), "stack")
            assert [agent.act(obs(0)).action[0, 0] for _ in range(3)] == [1, 2, 3]
            wait_for(lambda: "its episode is not recorded" in caplog.text)
            agent.act(obs(0))
    assert caplog.text.count("is not recorded") == 1


@pytest.mark.library("rerun")
def test_a_session_that_is_not_there_has_no_file(tmp_path: Path) -> None:
    with live_server(Counting()) as server, recorded(server, tmp_path):
        refused = Reply(error=UnknownSession("send a reset first"))
        observe(server.view.live, "nobody", Request("act", obs(0)), refused)
    assert list(tmp_path.iterdir()) == []


def test_without_a_target_nothing_runs_and_nobody_looks() -> None:
    with live_server(Counting()) as server, RemoteAgent(server.url, transport="http") as agent:
        agent.reset(obs(0))
        agent.act(obs(0))
        assert server.engine.observers.any is False
