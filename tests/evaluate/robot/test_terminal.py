"""The operator at a real terminal."""

from __future__ import annotations

import os
import pty
from collections.abc import Iterator
from pathlib import Path

import pytest

from vlagents_ray.evaluate.robot import TerminalOperator, VisibleTrial


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """What is written there is typed at this process's terminal."""
    main, terminal = pty.openpty()
    with os.fdopen(terminal) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        yield main
    os.close(main)


def test_enter_stops_a_trial_once(keyboard: int) -> None:
    person = TerminalOperator()
    assert not person.stops()
    os.write(keyboard, b"stop")
    assert not person.stops(), "the line has no end yet"
    os.write(keyboard, b"\n")
    assert person.stops()
    assert not person.stops(), "it is read, and no answer to the next question"


def test_lines_of_a_pipe_are_left_for_the_questions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "answers").write_text("s\n")
    with (tmp_path / "answers").open() as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        assert not TerminalOperator().stops()
        assert stdin.read() == "s\n"


def test_a_word_that_is_no_verdict_is_asked_again() -> None:
    typed = iter(["maybe", "p", "", "S", "well done"])
    trial = VisibleTrial(1, 2, "drawer", 1, 1, "open the drawer", "", 4.0, rubric={})
    said: list[str] = []
    verdict = TerminalOperator(lambda _: next(typed), said.append).judge(trial, "the trial is over")
    assert (verdict.outcome, verdict.note) == ("success", "well done")
    assert "want some of the rubric's" in said[-1], "a task without a rubric has no partial success"
