"""Blind evaluation on a real robot: a person resets the scene and judges, and does not see which policy plays.

`evaluate_on_robot` plays a plan's trials in an order that the plan's key draws (`schedule`). The person is an
`Operator`: at a page in the browser (`PageOperator`), at a terminal (`TerminalOperator`), or any class with the same
methods.
"""

from vlagents_ray.evaluate.robot.operator import Operator, Verdict, VisibleTrial
from vlagents_ray.evaluate.robot.run import TrialsInterrupted, evaluate_on_robot, planned_cells, unblind
from vlagents_ray.evaluate.robot.schedule import Trial, schedule
from vlagents_ray.evaluate.robot.terminal import TerminalOperator
from vlagents_ray.evaluate.robot.web_operator import PageOperator

__all__ = [
    "Operator",
    "PageOperator",
    "TerminalOperator",
    "Trial",
    "TrialsInterrupted",
    "Verdict",
    "VisibleTrial",
    "evaluate_on_robot",
    "planned_cells",
    "schedule",
    "unblind",
]
