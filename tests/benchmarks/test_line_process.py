"""Tests of the line protocol between a benchmark and its processes."""

from __future__ import annotations

import pytest

from benchmarks.line_process import LineProcess, ProcessFailed


def test_lines_that_come_together_are_heard_one_by_one() -> None:
    with LineProcess("two lines", ["sh", "-c", "echo 1; echo 2; cat"]) as child:
        assert [child.read(10), child.read(10)] == [1, 2]
        assert child.request("[3]", 10) == [3]


def test_silence_and_nonsense_are_errors() -> None:
    with (
        LineProcess("mute", ["sleep", "60"], end_s=0.1) as mute,
        pytest.raises(ProcessFailed, match=r"no answer within 0\.1 s"),
    ):
        mute.read(0.1)
    with (
        LineProcess("talker", ["echo", "hello"]) as talker,
        pytest.raises(ProcessFailed, match="expected a line of JSON"),
    ):
        talker.read(10)


def test_variables_are_added_and_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KEPT", "1")
    monkeypatch.setenv("GONE", "1")
    command = ["sh", "-c", 'echo \\"$KEPT/${GONE-unset}/$NEW\\"']
    with LineProcess("variables", command, {"GONE": None, "NEW": "2"}) as child:
        assert child.read(10) == "1/unset/2"
