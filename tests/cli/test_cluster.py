"""The processes that a warm cluster keeps ready, and `vlagents-ray up` and `down` without one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vlagents_ray.cli.main import app


def test_there_is_nothing_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    ended = CliRunner().invoke(app, ["down"])
    assert ended.exit_code == 2
    assert "no warm cluster of yours is up on this machine; `vlagents-ray up` starts one" in ended.output


class TestIdleWorkers:
    """Which processes are started ahead, and when."""

    @pytest.fixture
    def started(self, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, Mapping[str, str]]]:
        from vlagents_ray.cli.cluster import keeper

        found: list[tuple[int, Mapping[str, str]]] = []
        monkeypatch.setattr(keeper, "start_workers_ahead", lambda *said: found.append(said))
        return found

    def refill(self, *counts: tuple[int, int]) -> None:
        from vlagents_ray.cli.cluster.keeper import IdleWorkers

        workers = IdleWorkers({"replica": 1, "evaluation": 2}, {"replica": {}, "evaluation": {"A": "1"}})
        for replica, evaluation in counts:
            workers.refill({"replica": replica, "evaluation": evaluation})

    def test_what_is_missing_is_started_once_nobody_takes_any(
        self, started: list[tuple[int, Mapping[str, str]]]
    ) -> None:
        self.refill((1, 2), (0, 2), (0, 1))
        assert started == []
        self.refill((0, 1), (0, 1))
        assert started == [(1, {}), (1, {"A": "1"})]

    def test_they_are_not_started_twice_while_they_appear(self, started: list[tuple[int, Mapping[str, str]]]) -> None:
        self.refill((0, 2), (0, 2), (0, 2), (1, 2), (1, 2))
        assert started == [(1, {})]

    @pytest.mark.parametrize("looks", [2, 30])
    def test_those_that_take_long_to_appear_are_not_started_again(
        self, looks: int, started: list[tuple[int, Mapping[str, str]]]
    ) -> None:
        """Ray's daemon is asked for so many more each time, and they stay for ever."""
        self.refill(*[(1, 0)] * (looks + 1))
        assert started == [(2, {"A": "1"})]

    def test_those_that_never_appear_are_started_again(self, started: list[tuple[int, Mapping[str, str]]]) -> None:
        from vlagents_ray.cli.cluster.keeper import _LOOKS

        self.refill(*[(1, 0)] * (_LOOKS + 3))
        assert started == [(2, {"A": "1"})] * 2

    def test_what_is_taken_while_others_appear_is_replaced(self, started: list[tuple[int, Mapping[str, str]]]) -> None:
        self.refill((1, 0), (1, 0), (0, 0), (0, 1), (0, 2), (0, 2))
        assert started == [(2, {"A": "1"}), (1, {})]

    def test_there_are_never_more_than_wanted(self, started: list[tuple[int, Mapping[str, str]]]) -> None:
        """Though they may be taken for another kind, whose environment Ray's title has overwritten."""
        self.refill((3, 0), (3, 0))
        assert started == []
