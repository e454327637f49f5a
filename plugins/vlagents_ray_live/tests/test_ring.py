"""Tests of the last seconds of each session, and of the episodes that are saved from them."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from eval_fakes import wait_for
from live_server import LiveServer, live_server
from pydantic import ValidationError

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.interface import Act, Agent
from vlagents_ray_live.ring import LiveConfig, Ring

IMAGE = np.random.default_rng(0).integers(0, 255, (64, 96, 3), np.uint8)


class Counts(Agent):
    """Returns chunks whose first row is the number of the act."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, object]:
        self.acts = 0
        return {}

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        return Act(np.stack([np.full(2, self.acts), np.zeros(2)]).astype(np.float32))


@pytest.fixture
def settings(tmp_path: Path) -> LiveConfig:
    return LiveConfig(folder=str(tmp_path / "saved"))


@pytest.fixture
def server(settings: LiveConfig) -> Iterator[LiveServer]:
    with live_server(Counts(), settings=settings) as one:
        yield one


def ring_of(server: LiveServer) -> Ring:
    assert server.view.ring is not None
    return server.view.ring


def drive(agent: RemoteAgent, acts: int) -> str:
    """Request this number of actions, one every 0.11 s."""
    obs = Obs({"front": IMAGE}, 0.5, {"joints": np.arange(3, dtype=np.float32)})
    agent.reset(obs, "stack the cups")
    for number in range(acts):
        obs.state["joints"] = np.full(3, number, np.float32)
        agent.act(obs)
        time.sleep(0.11)
    return "stack the cups"


def pressed(server: LiveServer, session: str) -> dict[str, str]:
    """Press "save", and return the outcome."""
    server.view.press(session, "save", "lab")
    wait_for(lambda: server.view.commands.describe(session)[-1]["state"] in ("done", "refused"), 60)
    found: dict[str, str] = server.view.commands.describe(session)[-1]
    return found


@pytest.mark.slow
@pytest.mark.parametrize("codec", ["jpeg", "raw"])
def test_a_press_makes_an_episode(server: LiveServer, settings: LiveConfig, codec: str) -> None:
    with RemoteAgent(server.url, codec=codec) as agent:
        drive(agent, 8)
        [session] = server.engine.sessions.ids()
        root = Path(pressed(server, session)["why"])
        assert root.parent == Path(settings.folder)
        drive(agent, 4)
        assert Path(pressed(server, session)["why"]) == root
    info = json.loads((root / "meta" / "info.json").read_text())
    assert (info["total_episodes"], info["fps"]) == (2, 10)
    assert info["features"]["observation.images.front"]["shape"] == [64, 96, 3]
    rows = [
        table
        for path in sorted((root / "data").rglob("*.parquet"))
        for table in pq.read_table(path).to_pylist()
    ]
    first = [row for row in rows if row["episode_index"] == 0]
    assert len(first) >= 4
    for row in first:
        # The answer to the observation with the number n is n + 1.
        assert row["action"] == [row["observation.state"][0] + 1] * 2
        assert row["observation.state"][3] == pytest.approx(0.5)
    times = [row["captured_at"] for row in first]
    assert times == sorted(times)
    assert abs(times[-1] - time.time()) < 60


def test_the_oldest_goes_first_when_the_memory_is_full(tmp_path: Path) -> None:
    with live_server(Counts(), settings=LiveConfig(folder=str(tmp_path), memory_mb=0.02)) as server:
        ring = ring_of(server)
        with RemoteAgent(server.url, codec="jpeg") as agent:
            drive(agent, 10)
            [session] = server.engine.sessions.ids()
            assert 0 < ring.bytes <= 20_000
            kept = [frame.action[0] for frame in ring._frames[session]]
            assert kept == sorted(kept)
            assert kept[0] > 1
        wait_for(lambda: ring.bytes == 0, 30)  # the session has ended


def test_old_frames_are_dropped(tmp_path: Path) -> None:
    settings = LiveConfig(folder=str(tmp_path), ring_s=0.3)
    with live_server(Counts(), settings=settings) as server, RemoteAgent(server.url) as agent:
        drive(agent, 8)
        [session] = server.engine.sessions.ids()
        assert len(ring_of(server)._frames[session]) <= 5
        wait_for(lambda: ring_of(server).bytes == 0, 30)
        assert "nothing to save" in pressed(server, session)["why"]


@pytest.mark.parametrize(("settings", "why"), [(None, "live: {folder"), ("file", "")])
def test_where_nothing_can_be_saved_a_press_says_why(
    tmp_path: Path, settings: str | None, why: str
) -> None:
    """Without the setting no frames are kept; with it, the folder is a file, so nothing can be
    saved.
    """
    (tmp_path / "file").write_text("")
    args = None if settings is None else LiveConfig(folder=str(tmp_path / settings))
    with live_server(Counts(), settings=args) as server, RemoteAgent(server.url) as agent:
        drive(agent, 3)
        [session] = server.engine.sessions.ids()
        said = pressed(server, session)
        assert said["state"] == "refused"
        assert said["why"]
        assert why in said["why"]


def test_settings_of_a_ring_without_a_folder_are_refused() -> None:
    with pytest.raises(ValidationError, match="expected a folder with ring_s, got none"):
        LiveConfig(ring_s=10.0)
