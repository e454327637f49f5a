"""Commands from the live page, on the robot's computer."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray.chunking.control import RobotControl
from vlagents_ray.client.commands import COMMAND, COMMANDED, CommandInbox
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.interface import Act, Obs


def told(do: str, **more: str) -> Act:
    return Act(
        np.zeros(2, np.float32), info={COMMAND: {"id": f"id of {do}", "do": do, **more}, "other": 1}
    )


def test_commands_are_obeyed_and_answered_once_an_answer_has_come() -> None:
    inbox, control = CommandInbox(), RobotControl()
    for act in (told("pause"), told("stop", by="lab"), told("success")):
        assert inbox.with_outcomes(Obs()).info == {}
        inbox.receive(act)
        assert act.info == {"other": 1}
    assert [command.do for command in inbox.apply(control)] == ["pause", "stop", "success"]
    assert (control.stops, control.reason) == (
        ["the live page by lab"],
        "paused from the live page",
    )
    assert control.over
    answers = {f"id of {do}": "" for do in ("pause", "stop", "success")}
    assert inbox.with_outcomes(Obs(info={"a": 1})).info == {"a": 1, COMMANDED: answers}
    inbox.receive(PolicyFailed("lost"))
    # sent again, since the first message may have been lost
    assert inbox.with_outcomes(Obs()).info == {COMMANDED: answers}
    inbox.receive(Act(np.zeros(2, np.float32)))
    assert inbox.with_outcomes(Obs()).info == {}


@pytest.mark.parametrize("do", ["resume", "instruct", "restart", "take over", "move", "dance"])
def test_a_command_that_could_start_a_motion_does_not_exist(do: str) -> None:
    inbox, control = CommandInbox(), RobotControl()
    control.pause("by the operator")
    control.stop("by the operator")
    inbox.receive(told(do, text="fold the cloth"))
    assert inbox.apply(control) == []
    assert (control.stopped, control.reason, control.over) == (True, "by the operator", False)
    assert "expected a command of" in inbox.with_outcomes(Obs()).info[COMMANDED][f"id of {do}"]


def test_what_is_not_allowed_is_refused_and_what_has_another_form_left_out() -> None:
    inbox, control = CommandInbox(allow=["stop"]), RobotControl()
    for act in (told("pause"), told("stop")):
        inbox.receive(act)
    inbox.apply(control)
    assert (control.stopped, control.reason) == (True, None)
    assert "not allowed" in inbox.with_outcomes(Obs()).info[COMMANDED]["id of pause"]
    with pytest.raises(ConfigError, match="dance"):
        CommandInbox(allow=["dance"])
    for stated in (None, "stop", {"do": "stop"}, {"id": 1, "do": "stop"}):
        inbox = CommandInbox()
        inbox.receive(Act(np.zeros(2, np.float32), info={COMMAND: stated}))
        assert inbox.apply(RobotControl()) == []
        assert inbox.with_outcomes(Obs()).info == {}


def test_the_name_of_a_key_forges_no_line_of_the_robots_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    inbox = CommandInbox()
    inbox.receive(told("stop", by="lab\n2026-11-28 INFO robot: restarted by \x1b[2Janna"))
    inbox.apply(RobotControl())
    [record] = caplog.records
    first, *further = record.getMessage().split("\n")
    assert "\x1b" not in record.getMessage()
    assert all(line.startswith("  ") for line in further)
    assert first == "stopped from the live page by lab"
