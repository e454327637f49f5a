"""Recorded actions, played back."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlagents_ray import Obs
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.policies.replay import Replay, load_actions
from vlagents_ray.testing import check_agent

ROWS = np.arange(6, dtype=np.float32).reshape(3, 2)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "rollout.npy"
    np.save(path, ROWS)
    return path


def played(path: Path, steps: int, **config: Any) -> list[list[Any]]:
    agent = Replay.from_config({"path": str(path), **config})
    agent.initialize()
    agent.reset(Obs(), None)
    return [agent.act(Obs()).action.tolist() for _ in range(steps)]


@pytest.mark.parametrize("chunk", [1, 2, 4])
def test_keeps_the_contract(recording: Path, chunk: int) -> None:
    check_agent(Replay.from_config({"path": recording, "chunk": chunk}))


def test_rows_come_in_order_and_from_the_start_in_each_episode(recording: Path) -> None:
    agent = Replay.from_config({"path": recording})
    agent.initialize()
    for _ in range(2):
        assert agent.reset(Obs(), None) == {"rows": 3}
        assert [agent.act(Obs()).action.tolist() for _ in range(3)] == ROWS.tolist()


def test_after_the_end_it_holds_or_sends_zeros_or_fails(recording: Path) -> None:
    assert played(recording, 5)[3:] == [[4.0, 5.0], [4.0, 5.0]]
    assert played(recording, 5, at_end="zeros")[3:] == [[0.0, 0.0], [0.0, 0.0]]
    with pytest.raises(PolicyFailed, match="ended after 3 rows"):
        played(recording, 4, at_end="error")


def test_a_chunk_over_the_end_is_filled_up(recording: Path) -> None:
    assert played(recording, 2, chunk=2) == [[[0, 1], [2, 3]], [[4, 5], [4, 5]]]
    assert played(recording, 2, chunk=2, at_end="zeros")[1] == [[4, 5], [0, 0]]
    with pytest.raises(PolicyFailed):
        played(recording, 2, chunk=2, at_end="error")


def test_the_contract_states_the_width_of_the_recording(recording: Path) -> None:
    agent = Replay.from_config({"path": recording})
    assert agent.contract.action.dim is None
    agent.initialize()
    assert agent.contract.action.dim == 2


def test_changing_a_returned_action_leaves_the_recording_alone(recording: Path) -> None:
    agent = Replay.from_config({"path": recording, "chunk": 2})
    agent.initialize()
    for _ in range(2):
        agent.reset(Obs(), None)
        action = agent.act(Obs()).action
        assert action.tolist() == ROWS[:2].tolist()
        action[:] = 99


def test_act_before_initialize_is_refused(recording: Path) -> None:
    with pytest.raises(PolicyFailed, match="initialize"):
        Replay.from_config({"path": recording}).act(Obs())


def test_npz_and_json_are_read(tmp_path: Path) -> None:
    np.savez(tmp_path / "one.npz", whatever=ROWS)
    np.savez(tmp_path / "several.npz", actions=ROWS, state=np.zeros(3))
    (tmp_path / "bare.json").write_text(json.dumps(ROWS.tolist()))
    (tmp_path / "named.json").write_text(json.dumps({"action": ROWS.tolist(), "fps": 10}))
    for name in ("one.npz", "several.npz", "bare.json", "named.json"):
        assert np.array_equal(load_actions(tmp_path / name), ROWS), name
    assert np.array_equal(load_actions(tmp_path / "several.npz", "actions"), ROWS)


def test_a_recording_that_cannot_be_played_is_named_with_its_fault(tmp_path: Path) -> None:
    np.savez(tmp_path / "two.npz", left=ROWS, right=ROWS)
    np.save(tmp_path / "flat.npy", np.zeros(4))
    np.save(tmp_path / "nan.npy", np.full((2, 2), np.nan))
    np.save(tmp_path / "objects.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.save(tmp_path / "none.npy", np.zeros((0, 3)))
    (tmp_path / "rows.csv").write_text("1,2")
    (tmp_path / "broken.json").write_text("[[1, 2], [3")
    (tmp_path / "ragged.json").write_text("[[1, 2], [3]]")
    (tmp_path / "text.json").write_text('[["a", "b"]]')
    (tmp_path / "torn.npy").write_bytes(b"\x93NUMPY\x01\x00")
    (tmp_path / "torn.npz").write_bytes(b"PK\x03\x04 not a zip")
    (tmp_path / "empty.npy").write_bytes(b"")
    np.save(tmp_path / "bare.npy", ROWS)
    (tmp_path / "bare.npy").rename(tmp_path / "bare.npz")
    with zipfile.ZipFile(tmp_path / "foreign.npz", "w") as archive:
        archive.writestr("notes.txt", "hello")
    faults = {
        "absent.npy": "no such file",
        "two.npz": "'left', 'right'",
        "flat.npy": r"\(4,\)",
        "nan.npy": "NaN",
        "objects.npy": "cannot be read",
        "none.npy": "at least 1",
        "rows.csv": "csv",
        "broken.json": "cannot be read",
        "ragged.json": "cannot be read",
        "text.json": "cannot be read",
        "torn.npy": "cannot be read",
        "torn.npz": "cannot be read",
        "foreign.npz": "cannot be read",
        "empty.npy": "cannot be read",
        "bare.npz": "rename it",
    }
    for name, fault in faults.items():
        with pytest.raises(ConfigError, match=fault):
            load_actions(tmp_path / name)


def test_a_key_that_is_not_there_is_refused(tmp_path: Path, recording: Path) -> None:
    np.savez(tmp_path / "two.npz", left=ROWS, right=ROWS)
    with pytest.raises(ConfigError, match="'middle'"):
        load_actions(tmp_path / "two.npz", "middle")
    with pytest.raises(ConfigError, match="one array"):
        load_actions(recording, "actions")


def test_the_path_is_required_and_at_end_is_closed(recording: Path) -> None:
    with pytest.raises(ConfigError, match="path"):
        Replay.from_config({})
    with pytest.raises(ConfigError, match="at_end"):
        Replay.from_config({"path": recording, "at_end": "loop"})
