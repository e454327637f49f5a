"""The code of a run, beside its results."""

from __future__ import annotations

from pathlib import Path

import pytest

from vlagents_ray.evaluate.artifacts import storage
from vlagents_ray.evaluate.artifacts.storage import policy_code, save_diffs
from vlagents_ray.ray_tools.git_state import GitState

DIRTY = GitState("c" * 40, "d" * 64, b"-a\n+b\n")
CLEAN = GitState("c" * 40, None, b"")


def test_each_difference_is_stored_once_under_its_digest(tmp_path: Path) -> None:
    save_diffs(tmp_path, [DIRTY, None, CLEAN, DIRTY])
    save_diffs(tmp_path, [DIRTY])
    [path] = (tmp_path / "provenance").iterdir()
    assert (path.name, path.read_bytes()) == (f"{'d' * 64}.diff", DIRTY.diff)


def test_the_difference_of_a_policy_is_known_only_if_its_server_has_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage, "code_of", lambda _target: DIRTY)
    assert policy_code({"policy": "noop", "code": DIRTY.to_json()}) is DIRTY
    assert policy_code({"policy": "noop", "code": CLEAN.to_json()}) is None
    assert policy_code({"policy": "noop"}) is None
    assert policy_code({}) is None
