"""Blind evaluation on a real robot: an operator resets the scene and judges each trial without
knowing which policy runs.

`evaluate_on_robot` runs a plan's trials in a random order, which is derived from the plan's key
(see `schedule`). The operator answers through an `Operator`: a page in the browser
(`PageOperator`), a terminal (`TerminalOperator`), or any class with the same methods.
"""

from vlagents_ray.evaluate.robot.operator import (
    Operator,
    PageOperator,
    TerminalOperator,
    Verdict,
    VisibleTrial,
)
from vlagents_ray.evaluate.robot.run import (
    TrialsInterrupted,
    evaluate_on_robot,
    play_trials,
    require_trials,
    unblind,
)
from vlagents_ray.evaluate.robot.trial import Trial, schedule

__all__ = [
    "Operator",
    "PageOperator",
    "TerminalOperator",
    "Trial",
    "TrialsInterrupted",
    "Verdict",
    "VisibleTrial",
    "evaluate_on_robot",
    "play_trials",
    "require_trials",
    "schedule",
    "unblind",
]
