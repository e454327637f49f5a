"""Blind evaluation on a real robot: an operator resets the scene and judges, without seeing which
policy runs.

`evaluate_on_robot` runs a plan's trials in an order that the plan's key draws (`schedule`). The
operator is an `Operator`: at a page in the browser (`PageOperator`), at a terminal
(`TerminalOperator`), or any class with the same methods.
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
