"""Check a robot before a policy moves it: readings, pictures and `stop` at rest, then small moves,
joint by joint.

Nothing moves without --move. With it, each motion begins only after the operator at the robot has
agreed. A simulated arm, "mujoco:ARM", is checked without an operator.

Exit status: 0 if no check found a violation, 1 if a check found one, 2 if the check could not run,
3 if the robot lacks declarations that the checks of its motion need.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial

from vlagents_ray.cli.arguments import CommandParser, number, parse_all
from vlagents_ray.cli.help_page import error_line
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.robot.loop import opened, robot_factory
from vlagents_ray_robot.check import Operator, RobotReport, examine
from vlagents_ray_robot.mujoco_arm import SimulatedClock

UNDECLARED = 3  # exit status
EXAMPLES = (
    "robot check mujoco:so101",
    "robot check my_arm:MyArm --robot-set port=/dev/ttyACM0 --move --out check.html",
)


def main(arguments: Sequence[str]) -> int:
    """Run the command, and return its exit status."""
    parser = command_parser()
    options = parse_all(parser, arguments, {"--report": "the page is written by --out FILE"})

    try:
        with contextlib.ExitStack() as stack:
            # Standard output has only the JSON document; questions to the operator go to standard
            # error.
            if options.json:
                stack.enter_context(contextlib.redirect_stdout(sys.stderr))
            report = _examine(options, stack)
        report.robot = options.robot
    except VLAgentsError as error:
        print(error_line(f"{type(error).__name__}: {error}"), file=sys.stderr)  # noqa: T201
        return 2

    if options.json:
        document = {
            "ok": report.ok,
            "verdict": report.verdict,
            **asdict(replace(report, pictures={})),
        }
        print(json.dumps(document, indent=2))  # noqa: T201
    else:
        print("\n".join(report.lines()))  # noqa: T201

    if options.out:
        report.write(options.out)
        print(f"report: {options.out}", file=sys.stderr)  # noqa: T201

    if report.findings:
        return 1
    return 0 if report.ok else UNDECLARED


def _examine(options: argparse.Namespace, stack: contextlib.ExitStack) -> RobotReport:
    """Open the robot within the context of `stack`, and check it."""
    make = robot_factory("robot", options.robot, options.robot_set)
    if options.robot.startswith("mujoco:"):
        make = partial(make, clock=SimulatedClock())
    robot = stack.enter_context(opened(make))

    contract = None
    if options.policy is not None:
        with RemoteAgent(options.policy) as agent:
            contract = agent.contract

    return examine(
        robot,
        contract=contract,
        operator=getattr(robot, "operator", None) or Operator(move=options.move),
        hz=options.hz,
        latency_s=options.latency_ms / 1e3,
        clock=getattr(robot, "clock", time),
    )


def command_parser() -> CommandParser:
    """Return the parser of the command's arguments."""
    parser = CommandParser("vlagents-ray robot check", __doc__ or "", EXAMPLES)
    parser.add_argument(
        "robot",
        metavar="ROBOT",
        help="The robot, such as my_arm:MyArm, lerobot:so101_follower, mujoco:so101, mujoco:PATH "
        "with an MJCF or URDF file, or ros:FILE.",
    )

    add = parser.general.add_argument
    add(
        "--robot-set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="An argument of the robot. May be repeated.",
    )
    add(
        "--move",
        action="store_true",
        help="Make small moves, each after a question at the terminal.",
    )
    add(
        "--policy",
        metavar="URL",
        help="Check against the contract of this server's policy instead of the robot's own "
        "contract.",
    )
    add(
        "--hz",
        type=number(above=True, maximum=10_000.0),
        metavar="HZ",
        help="Control rate in Hz; default: the contract's, or 50.",
    )
    add(
        "--latency-ms",
        type=number(maximum=60_000.0),
        default=400.0,
        metavar="MS",
        help="Longest time from a command to its motion, in ms.",
    )
    add("--out", metavar="FILE", help="Write the report, with pictures, as an HTML page.")
    add("--json", action="store_true", help="Print the report as JSON, for programs.")
    return parser
