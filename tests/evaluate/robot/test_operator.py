"""The operator's page: its answers, its access control, and a whole evaluation with it; and the
operator at a terminal.
"""

from __future__ import annotations

import contextlib
import json
import os
import pty
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import wait_for
from robot_trials import NAMES, URLS, Arm, Evaluation, plan, tasks

from vlagents_ray.evaluate.robot import (
    PageOperator,
    TerminalOperator,
    TrialsInterrupted,
    VisibleTrial,
)
from vlagents_ray.images.jpeg_png import decode


class Person:
    """A person at the page, over HTTP; `read` has all texts that they were shown."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.read = b""

    def get(self, path: str) -> bytes:
        with urllib.request.urlopen(self.url + path, timeout=30) as answer:
            data: bytes = answer.read()
        self.read += data
        return data

    def state(self) -> dict[str, Any]:
        return dict(json.loads(self.get("now/state")))

    def until(self, phase: str) -> dict[str, Any]:
        found: dict[str, Any] = {}

        def is_there() -> bool:
            nonlocal found
            found = self.state()
            return found["phase"] == phase and not found["answered"]

        wait_for(is_there)
        return found

    def answer(self, do: str, state: dict[str, Any], **more: Any) -> int:
        about = {
            "phase": state["phase"],
            "trial": state["trial"]["number"],
            "attempt": state["trial"]["attempt"],
        }
        return self.post(json.dumps({**about, "do": do, **more}).encode())

    def post(self, body: bytes, kind: str = "application/json") -> int:
        request = urllib.request.Request(self.url + "now/answer", body, {"content-type": kind})
        try:
            with urllib.request.urlopen(request, timeout=30) as answer:
                return int(answer.status)
        except urllib.error.HTTPError as error:
            self.read += error.read()
            return error.code


@pytest.fixture
def operator() -> Iterator[PageOperator]:
    with PageOperator(say=lambda _: None) as made:
        yield made
        watching = threading.Thread(target=watch_to_the_end, args=[Person(made.url)])
        watching.start()
    watching.join()


def watch_to_the_end(person: Person) -> None:
    """Poll like an open page: the operator waits until an open page has shown the end of the
    evaluation.
    """
    with contextlib.suppress(OSError):  # the server has already ended
        while person.state()["phase"] != "end":
            time.sleep(0.01)


def test_a_whole_evaluation_over_the_page_shows_no_policy(
    tmp_path: Path, operator: PageOperator
) -> None:
    person = Person(operator.url)
    config = plan(tmp_path / "out", suite={"episodes": 1})
    run = Evaluation(config, operator, Arm())
    for file in ("", "operator.css", "operator.js"):
        person.get(file)
    for number in range(1, 5):
        scene = person.until("scene")
        assert (scene["trial"]["number"], scene["trial"]["total"]) == (number, 4)
        assert scene["trial"]["start"] == (["front"] if number % 2 == 0 else [])
        wait_for(lambda: person.state()["cameras"] == ["front"])
        assert decode(person.get("now/camera/front")).shape == (32, 32, 3)
        if number % 2 == 0:
            assert decode(person.get("start/front")).shape == (32, 32, 3)
        assert person.answer("ready", scene) == 200
        verdict = person.until("verdict")
        assert verdict["ending"] == "the trial is over"
        assert person.answer("repeat", verdict) == 400, "the answer requires a reason"
        earned = ["the cup is on the plate"]
        assert (
            person.answer(
                "partial" if number < 3 else "success", verdict, earned=earned, note="slowly"
            )
            == 200
        )
    run.join()
    assert run.error is None
    assert run.summary is not None
    assert run.summary.total.success_once.successes == 2
    assert run.summary.total.mean_return == pytest.approx((0.75 + 0.75 + 1 + 1) / 4)
    for text in (*NAMES, *URLS.values(), "4711", "digest-of", "fingerprint-of"):
        assert text.encode() not in person.read


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (None, "is complete"),
        (KeyboardInterrupt(), "--resume"),
        (ValueError("pi0"), "see the terminal"),
    ],
)
def test_an_open_page_says_how_the_evaluation_ended(error: BaseException | None, said: str) -> None:
    """The page must show the end before the server stops, since later an end looks like a lost
    connection.
    """
    read: list[dict[str, Any]] = []

    def watch(person: Person) -> None:
        while not read or read[-1]["phase"] != "end":
            read.append(person.state())

    with (
        contextlib.suppress(KeyboardInterrupt, ValueError),
        PageOperator(say=lambda _: None) as operator,
    ):
        watching = threading.Thread(target=watch, args=[Person(operator.url)])
        watching.start()
        wait_for(lambda: read)
        if error is not None:
            raise error
    watching.join()
    assert said in read[-1]["ending"]
    assert "pi0" not in read[-1]["ending"]


def test_an_answer_counts_for_the_question_that_was_shown(
    tmp_path: Path, operator: PageOperator
) -> None:
    person = Person(operator.url)
    run = Evaluation(plan(tmp_path / "out"), operator, arm := Arm())
    scene = person.until("scene")
    assert person.answer("success", scene) == 400
    assert person.answer("stop", {**scene, "phase": "playing"}) == 409
    assert person.answer("ready", {**scene, "trial": {**scene["trial"], "number": 2}}) == 409
    assert person.post(b"[" * 9999) == 400
    assert person.post(b"{}") == 400
    assert person.post(b" " * 20_000) == 413
    assert person.post(b"{}", "text/plain") == 415, (
        "a form of another site can send this content type without a preflight request"
    )
    assert arm.applied == 0, "the robot did not move"
    assert person.answer("end", scene) == 200
    run.join()
    assert isinstance(run.error, TrialsInterrupted)


def test_without_the_addresss_random_part_there_is_no_answer(operator: PageOperator) -> None:
    assert len(operator.url.split("/")[3]) == 32
    stranger = Person(operator.url[: operator.url.index("/", 8) + 1] + "x" * 32 + "/")
    for path in ("", "now/state", "operator.js"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            stranger.get(path)
    assert stranger.post(b"{}") == 404


def test_the_page_may_load_nothing_from_elsewhere(operator: PageOperator) -> None:
    with urllib.request.urlopen(operator.url, timeout=30) as answer:
        policy, html = answer.headers["content-security-policy"], answer.read().decode()
    assert policy.startswith(
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self';"
    )
    assert "http" not in html.replace("http-equiv", "")


@pytest.mark.slow
@pytest.mark.parametrize("how", ["stop", "leave"])
def test_a_trial_is_stopped_by_the_button_or_when_the_page_is_gone(
    tmp_path: Path, operator: PageOperator, how: str
) -> None:
    person = Person(operator.url)
    config = plan(
        tmp_path / "out", robot={"tasks": tasks(max_steps=200 * 60)}, suite={"envs": ["drawer"]}
    )
    run = Evaluation(config, operator, arm := Arm())
    assert person.answer("ready", person.until("scene")) == 200
    playing = person.until("playing")
    begun = time.monotonic()  # time of the page's last request
    wait_for(lambda: arm.applied > 10)
    if how == "stop":
        assert person.answer("stop", playing) == 200
    else:
        wait_for(lambda: arm.stopped)
        assert 2 < time.monotonic() - begun < 20
    verdict = person.until("verdict")
    assert arm.stopped
    applied = arm.applied
    assert verdict["ending"] == "stopped by the operator"
    assert person.answer("repeat", verdict, note="I was away") == 200
    again = person.until("scene")
    assert again["trial"]["message"] == "repeated: I was away"
    assert again["trial"]["attempt"] == 2
    assert arm.applied == applied
    person.answer("end", again)
    run.join()


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Yield a descriptor; text written to it is typed at this process's terminal."""
    main, terminal = pty.openpty()
    with os.fdopen(terminal) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        yield main
    os.close(main)


def test_enter_stops_a_trial_once(keyboard: int) -> None:
    person = TerminalOperator()
    assert not person.stops()
    os.write(keyboard, b"stop")
    assert not person.stops(), "the line is not complete"
    os.write(keyboard, b"\n")
    assert person.stops()
    assert not person.stops(), "the line is consumed, and does not answer the next question"


def test_lines_of_a_pipe_are_left_for_the_questions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    assert "expected only the rubric's" in said[-1], (
        "a task without a rubric has no partial success"
    )
