"""Check a robot before a policy moves it: readings, pictures and `stop` at rest, then small moves, joint by joint.

Nothing moves without --move, and then each motion only after a person at the robot has agreed. A simulated robot of
"mujoco:ARM" is checked without a person.

Exit status: 0 if no check found anything, 1 if one did, 2 if it could not run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.robot.check import examine
from vlagents_ray.robot.mujoco_arm import MujocoArm, SimulatedClock, SimulatedOperator
from vlagents_ray.robot.named import robot_named


class TerminalOperator:
    """The person at the robot, who answers at the terminal."""

    def __init__(self, *, move: bool) -> None:
        self._move = move

    def agrees(self, motion: str) -> bool:
        """Ask before each motion."""
        return self._move and _asked(f"The robot will do this: {motion}. Is its space free?") is True

    def holds_card(self, camera: str | None) -> bool:
        """Ask for something red."""
        if camera is None:
            return _asked("Take the card away. Done?") is True
        return _asked(f"Hold something red in the upper left quarter of what camera {camera!r} sees. Done?") is True

    def saw_joint(self, name: str, side: int) -> bool | None:
        """Ask which joint moved."""
        return _asked(f"Did {name} alone move, to the side that its manual calls {'+' if side > 0 else '-'}?")

    def saw_closing(self) -> bool | None:
        """Ask for the gripper."""
        return _asked("Is the gripper closed?")

    def sees_hand(self, pose: np.ndarray, arm: int = 0) -> bool | None:
        """Ask for the place of the hand."""
        x, y, z, *quaternion = np.round(pose, 2).tolist()
        place = f"{x} m in front of the base, {y} m to its left, {z} m above it, with the quaternion xyzw {quaternion}"
        return _asked(f"Is the hand of arm {arm + 1} there: {place}?")


def _asked(question: str) -> bool | None:
    """Return the answer to a question; None if the person cannot tell, or there is none."""
    try:
        answer = input(f"{question} [y/n, Enter: cannot tell] ").strip().lower()
    except EOFError:
        return None
    return {"y": True, "n": False}.get(answer[:1])


def main(arguments: Sequence[str]) -> int:
    """Run the command, and return its exit status."""
    options = command_parser().parse_args(arguments)
    try:
        make = robot_named("robot", options.robot, options.robot_set)
        simulated = options.robot.startswith("mujoco:")
        robot = make(clock=SimulatedClock()) if simulated else make()
        operator = SimulatedOperator(robot) if isinstance(robot, MujocoArm) else TerminalOperator(move=options.move)
        contract = None
        if options.policy is not None:
            with RemoteAgent(options.policy) as agent:
                contract = agent.contract
        clock = {"clock": robot.clock} if isinstance(robot, MujocoArm) else {}
        try:
            report = examine(
                robot, contract=contract, operator=operator, hz=options.hz, latency_s=options.latency_ms / 1e3, **clock
            )
        finally:
            getattr(robot, "close", lambda: None)()
    except VLAgentsError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)  # noqa: T201
        return 2
    print("\n".join(report.lines()))  # noqa: T201
    if options.report:
        report.write(options.report)
        print(f"report: {options.report}")  # noqa: T201
    return 0 if report.ok else 1


def command_parser() -> argparse.ArgumentParser:
    """Return the parser of the command."""
    parser = argparse.ArgumentParser(
        prog="vlagents-ray robot check", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("robot", help="my_arm:MyArm, lerobot:so101_follower, mujoco:so101, or mujoco:PATH of an MJCF or URDF file")
    add("--robot-set", metavar="KEY=VALUE", action="append", default=[], help="an argument of the robot, repeatable")
    add("--move", action="store_true", help="make small moves, each after a question at the terminal")
    add("--policy", metavar="URL", help="check by the contract of the policy of this server, not by the robot's own")
    add("--hz", type=float, help="control rate (default: the contract's, or 50)")
    add("--latency-ms", type=float, default=400.0, help="longest time from command to motion (%(default)s)")
    add("--report", metavar="FILE", help="write the report with pictures as an HTML page")
    return parser
