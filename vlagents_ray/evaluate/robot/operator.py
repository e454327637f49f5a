"""The person at the robot: what is asked of them, and what they are shown."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs

Outcome = Literal["success", "failure", "partial", "repeat"]


@dataclass(frozen=True, slots=True)
class VisibleTrial:
    """All that an operator is shown of a trial; nothing in it depends on the policy."""

    number: int  # from 1
    total: int  # of trials that are planned
    task: str
    scene: int  # from 1
    attempt: int  # from 1; higher after a repetition
    instruction: str
    setup: str  # how the scene is to be set
    seconds: float  # after which the trial ends
    rubric: Mapping[str, float]  # points by part of the task
    start: Mapping[str, Path] = field(default_factory=dict)  # the JPEG of each camera at the scene's first start
    message: str = ""  # how the attempt before ended, if it has no verdict

    def to_json(self) -> dict[str, Any]:
        """The fields for JSON; of the start pictures the names of the cameras."""
        names = ("number", "total", "task", "scene", "attempt", "instruction", "setup", "seconds", "message")
        fields = {name: getattr(self, name) for name in names}
        return fields | {"rubric": dict(self.rubric), "start": sorted(self.start)}


@dataclass(frozen=True, slots=True)
class Verdict:
    """The operator's judgement of a trial."""

    outcome: Outcome
    earned: tuple[str, ...] = ()  # the parts of the rubric that were reached, in a partial success
    note: str = ""  # for "repeat" the reason, which has to be given

    def score(self, rubric: Mapping[str, float]) -> float:
        """Return the share of the rubric's points that were earned: 1 for a success, 0 for a failure.

        Args:
            rubric: The points by part of the task.

        Raises:
            ConfigError: A partial success earned a part that the rubric does not have, or no rubric is there; or a
                repetition has no reason.
        """
        if self.outcome == "repeat" and not self.note.strip():
            raise ConfigError("verdict: got a repetition without a reason, want one in words")
        if self.outcome != "partial":
            return float(self.outcome == "success")
        if not rubric or (unknown := sorted(set(self.earned) - rubric.keys())):
            got = f"the parts {unknown}" if rubric else "a partial success"
            raise ConfigError(f"verdict: got {got}, want some of the rubric's {sorted(rubric)}; see `robot.tasks`")
        return sum(rubric[part] for part in set(self.earned)) / sum(rubric.values())


class Operator(Protocol):
    """The person at the robot, however they are reached; the methods are called from one thread, in this order."""

    def prepare(self, trial: VisibleTrial, observe: Callable[[], Obs]) -> bool:
        """Wait until the scene is set. The robot stays still.

        Args:
            trial: The next trial.
            observe: Reads the robot's sensors, for live pictures.

        Returns:
            True to begin the trial, False to end the evaluation; it can be resumed.
        """
        ...

    def watch(self, obs: Obs) -> None:
        """Show an observation of the running trial; called in each control tick, so it must return at once."""
        ...

    def stops(self) -> bool:
        """Return whether the running trial is to be stopped, as it is if nobody watches any more."""
        ...

    def judge(self, trial: VisibleTrial, ending: str) -> Verdict:
        """Ask for the verdict. The robot stays still.

        Args:
            trial: The trial that was played.
            ending: How it ended, in words.

        Returns:
            The verdict; one to repeat the trial has its reason in the note.

        Raises:
            KeyboardInterrupt: The operator has left. The trial will be played again.
        """
        ...
