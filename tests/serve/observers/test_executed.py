"""What robots executed, as viewers get it."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from live_server import ask, live_server

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.chunking.execution import PLAYED
from vlagents_ray.chunking.player import ChunkPlayer
from vlagents_ray.interface import Act, Agent
from vlagents_ray.protocol.json_messages import plain_values
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.observers.live import ROWS, VALUES, Executed

GOOD = {
    "step": 7,
    "steps": np.array([5, 6]),
    "rows": np.ones((2, 3), np.float32),
    "age_ms": 12.0,
    "safe": "",
    "late": 0,
}


class Counts(Agent):
    """Chunks of four rows, each of which is its step."""

    asked = 0

    def act(self, obs: Obs) -> Act:
        self.asked += 1
        return Act(np.arange(4, dtype=np.float32)[:, np.newaxis] + 4 * (self.asked - 1))


def test_planned_and_executed_rows_have_the_same_steps() -> None:
    with live_server(Counts()) as server, server.viewer() as viewer, RemoteAgent(server.url) as agent:
        ask(viewer)
        player = ChunkPlayer(agent)
        player.reset(Obs(), "count")
        executed: dict[int, float] = {}
        planned: dict[int, float] = {}
        while len(executed) < 12 or len(planned) < 12:
            player.act(Obs())
            [replica] = ask(viewer)[0]["replicas"]
            for session in replica["sessions"]:
                played, last = session.get("played"), session.get("last", {})
                if played is not None:
                    executed |= dict(zip(played["steps"], (row[0] for row in played["rows"]), strict=True))
                    assert (played["reconnects"], played["safe_spells"]) == (0, 0)
                if "at" in last:
                    planned |= {last["at"] + i: row[0] for i, row in enumerate(last["action"])}
        assert all(step == value for step, value in (executed | planned).items())


@pytest.mark.parametrize(
    "changes",
    [
        {"rows": [1]},
        {"steps": None},
        {"rows": np.ones(2, np.float32)},
        {"steps": np.zeros(3)},
        {"rows": np.ones((3, 3))},
    ],
)
def test_a_statement_of_another_form_is_left_out(changes: dict[str, Any]) -> None:
    assert Executed.from_request(Request("act", Obs(info={PLAYED: GOOD | changes}))) is None
    assert Executed.from_request(Request("act", Obs(info={PLAYED: [GOOD]}))) is None
    assert Executed.from_request(Request("act", Obs())) is None


@pytest.mark.parametrize("name", [*GOOD, "safe_ticks", "reconnects", "more"])
@pytest.mark.parametrize(
    "value",
    [
        "soon",
        "",
        b"7",
        True,
        None,
        [7],
        {"a": 1},
        float("nan"),
        float("inf"),
        10**30,
        np.float64(3),
        np.zeros(3),
        -1,
        2.5,
    ],
)
def test_entries_of_every_type_are_numbers_or_left_out(name: str, value: Any) -> None:
    played = Executed.from_request(Request("act", Obs(info={PLAYED: GOOD | {name: value}})))
    if played is None:
        assert name in ("steps", "rows")
        return
    text = json.dumps(plain_values({"steps": played.steps, "rows": played.rows, **played.numbers}), allow_nan=False)
    said = {key: one for key, one in json.loads(text).items() if key not in ("steps", "rows", "safe")}
    assert all(type(one) in (int, float) for one in said.values())
    assert "more" not in said


def test_a_statement_is_copied_and_bounded() -> None:
    rows = np.ones((500, 500), np.float32)
    stated = GOOD | {"rows": rows, "steps": np.arange(500), "safe": ["x"], "more": "y"}
    played = Executed.from_request(Request("act", Obs(info={PLAYED: stated})))
    assert played is not None
    assert played.rows.shape == (ROWS, VALUES)
    rows[:] = 0
    assert played.rows.all()
    assert played.numbers == {"step": 7, "age_ms": 12.0, "late": 0}
