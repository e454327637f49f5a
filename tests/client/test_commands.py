"""Commands from the live page, on the robot's computer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vlagents_ray.client.commands import COMMAND, COMMANDED, CommandInbox
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.interface import Act, Obs


class Robot:
    """Notes what it is to do; refuses to resume."""

    def __init__(self) -> None:
        self.did: list[str] = []

    def pause(self) -> None:
        self.did.append("pause")

    def resume(self) -> None:
        raise ConfigError("not now")

    def stop(self, by: str) -> None:
        self.did.append(f"stop by {by}")

    def mark(self, label: str) -> None:
        self.did.append(label)

    def instruct(self, text: str) -> None:
        self.did.append(f"instruct {text}")


def told(do: str, **more: str) -> Act:
    return Act(np.zeros(2, np.float32), info={COMMAND: {"id": f"id of {do}", "do": do, **more}, "other": 1})


def test_commands_are_obeyed_and_answered_once_an_answer_has_come() -> None:
    inbox, robot = CommandInbox(), Robot()
    for act in (told("pause"), told("stop", by="lab"), told("success"), told("instruct", text="fold"), told("resume")):
        assert inbox.asking(Obs()).info == {}
        inbox.came(act)
        assert act.info == {"other": 1}
    done = inbox.obey(robot)
    assert robot.did == ["pause", "stop by lab", "success", "instruct fold"]
    assert [command.do for command in done] == ["pause", "stop", "success", "instruct"]
    answers = {f"id of {do}": "" for do in ("pause", "stop", "success", "instruct")} | {"id of resume": "not now"}
    assert inbox.asking(Obs(info={"a": 1})).info == {"a": 1, COMMANDED: answers}
    inbox.came(PolicyFailed("lost"))
    assert inbox.asking(Obs()).info == {COMMANDED: answers}  # again, as the first may not have arrived
    inbox.came(Act(np.zeros(2, np.float32)))
    assert inbox.asking(Obs()).info == {}


def test_what_is_not_allowed_or_unknown_is_refused() -> None:
    inbox, robot = CommandInbox(allow=["stop"]), Robot()
    for act in (told("pause"), told("dance"), told("stop")):
        inbox.came(act)
    inbox.obey(robot)
    assert robot.did == ["stop by "]
    answers = inbox.asking(Obs()).info[COMMANDED]
    assert "not allowed" in answers["id of pause"]
    assert "not allowed" in answers["id of dance"]
    with pytest.raises(ConfigError, match="dance"):
        CommandInbox(allow=["dance"])


@pytest.mark.parametrize("stated", [None, "stop", {"do": "stop"}, {"id": 1, "do": "stop"}])
def test_a_command_of_another_form_is_left_out(stated: Any) -> None:
    inbox, robot = CommandInbox(), Robot()
    inbox.came(Act(np.zeros(2, np.float32), info={COMMAND: stated}))
    inbox.obey(robot)
    assert robot.did == []
    assert inbox.asking(Obs()).info == {}
