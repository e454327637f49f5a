"""A blind evaluation on a real robot from the command line."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from vlagents_ray.cli.console import out
from vlagents_ray.cli.evaluation.policies import served

if TYPE_CHECKING:
    from vlagents_ray.evaluate import EvalConfig


def run_on_robot(config: EvalConfig, address: str | None, *, operator: str, unblinded: bool) -> None:
    """Serve the policies that are not at a URL, play the trials, print the table.

    Args:
        config: The plan, with the robot's class.
        address: A running Ray cluster; by default one is started on this machine.
        operator: Where the person at the robot answers: "page" or "terminal".
        unblinded: Play nothing, and write the results of the trials that have a verdict.
    """
    from vlagents_ray.evaluate import print_summary
    from vlagents_ray.evaluate.robot import PageOperator, TerminalOperator, evaluate_on_robot, planned_cells, unblind

    if unblinded:
        print_summary(out, unblind(config.out, config.robot.key if config.robot is not None else None))
        return
    planned_cells(config)  # what is wrong is said before anything starts
    with served(config, address) as ready, contextlib.ExitStack() as stack:
        person = TerminalOperator() if operator == "terminal" else stack.enter_context(PageOperator(out.print))
        summary = evaluate_on_robot(ready, person)
    print_summary(out, summary)
