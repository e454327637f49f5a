"""A test suite for robots, which the arms of this package pass, and which your robots can also use.

from vlagents_ray_robot.testing import check_robot

def test_my_robot_keeps_its_contract():
    check_robot(MyArm())  # moves nothing; with operator=… it makes small moves
"""

from __future__ import annotations

from typing import Any

from vlagents_ray.robot.loop import Robot
from vlagents_ray.testing import ContractViolation
from vlagents_ray_robot.check import RobotReport, examine

__all__ = ["check_robot"]


def check_robot(robot: Robot, **options: Any) -> RobotReport:
    """Check that a robot implements `observe`, `apply` and `stop`, and that its readings are right.

    Args:
        robot: The robot.
        options: Further arguments of `vlagents_ray_robot.check.examine`. Without an `operator`
            nothing moves.

    Returns:
        The report, with the skipped checks.

    Raises:
        ContractViolation: A check found something; the message has every finding.
    """
    report = examine(robot, **options)
    if not report.ok:
        raise ContractViolation("\n".join(map(str, report.findings)))
    return report
