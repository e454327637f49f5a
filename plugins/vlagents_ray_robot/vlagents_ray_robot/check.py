"""A conformance suite for `observe`, `apply` and `stop` of a robot, before a policy moves it."""

from __future__ import annotations

import html
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, Contract, StateSpec, reordered
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.images.jpeg_png import data_url, encode_jpeg
from vlagents_ray.interface import CAPTURED, Obs
from vlagents_ray.robot.loop import Robot, contract_of
from vlagents_ray.signals import raise_dropped
from vlagents_ray.validation import check_observation

CHECKS = {  # in the order in which they run
    "observation": "observations fit the contract",
    "clock": "time stamps are current and never go back",
    "rate": "observe returns within half a tick, and returns new readings at the control rate",
    "units": (
        "joints are in the unit of the contract, positions in m, openings in [0, 1], "
        "quaternions of length 1"
    ),
    "limits": "the arm is within its limits",
    "stop": "stop returns at once, twice and from another thread, and ends a motion",
    "cameras": "names, colours and orientation of the cameras are right, and no picture is frozen",
    "place": "the hand is at the pose that the robot reports",
    "blocking": "apply does not wait for the motion",
    "meaning": (
        "a command to the present pose moves nothing: actions are absolute or relative, as the "
        "contract declares"
    ),
    "order": "each number of an action moves its own joint and no other",
    "sign": "each joint moves in the direction of its command",
    "size": "each joint moves as far as its command",
    "latency": "a motion is measured soon after its command",
    "pose": "the pose of the hand turns and moves about the axis of each joint",
    "commands": "each single command is executed",
    "gripper": "the gripper closes when it is commanded to close",
}
_STEPS = {"rad": 0.05, "deg": 3.0, "m": 0.01}  # the size of a small move, by unit of the joints
_OTHER_STEP = 3.0  # the size of a small move in LeRobot's units, per cent of the range
_RAMP_S = 0.4  # the time of a small move
_HOLD_S = 1.0  # the time after a small move within which it must be measured
# An arm that is further from its target than this number of small moves is stopped immediately.
_RUNAWAY = 3
_STOP_S = 0.1  # maximum time of a call of `stop`
# Range of the difference from an observation's time stamp to the present, s; the same as SKEW_S of
# the chunk player.
_SKEW_S = (-1.0, 0.1)
_FROZEN_S = 1.0  # the time within which each camera must return a new picture
_MOST_RAD = 2.1 * np.pi  # joints beyond a full turn are assumed to be in another unit
# The size of the largest joint below which the unit of joints is not known: radians below this size
# are within the noise of degrees. Other units are known only where radians end.
_NEAR_ZERO = {"rad": 0.1}
_MOST_M = 5.0  # a position further away is assumed to be in millimetres
_RED = 40  # the amount by which red must exceed green and blue where the card is, of 255
_DECLARE = "the robot's contract does not declare what this check needs"


class Operator:
    """The person at the robot, who answers questions at the terminal; a subclass may answer in
    another way.

    The answer None means that the operator cannot tell; the check is then listed as skipped.

    Args:
        move: Whether the robot may move; otherwise the operator agrees to no motion.
    """

    may_move = True  # whether the operator is asked to agree to motions

    def __init__(self, *, move: bool = True) -> None:
        self.may_move = move

    def agrees(self, motion: str) -> bool:
        """Return whether the robot may make this motion now."""
        question = f"The robot will do this: {motion}. Is its space free?"
        return self.may_move and _ask(question) is True

    def holds_card(self, camera: str | None) -> bool:
        """Hold something red in the upper left quarter of the picture of a camera.

        Args:
            camera: The camera; None to take the card away.

        Returns:
            Whether the operator has done this; False if there is no card.
        """
        request = "Take the card away"
        if camera is not None:
            request = f"Hold something red in the upper left quarter of what camera {camera!r} sees"
        return _ask(f"{request}. Done?") is True

    def saw_joint(self, name: str, side: int) -> bool | None:
        """Return whether this joint alone has moved since `agrees`, towards its positive (1) or
        negative (-1) side.
        """
        sign = "+" if side > 0 else "-"
        return _ask(f"Did {name} alone move, to the side that its manual calls {sign}?")

    def saw_closing(self) -> bool | None:
        """Return whether the gripper is closed now."""
        return _ask("Is the gripper closed?")

    def sees_hand(self, pose: np.ndarray, arm: int = 0) -> bool | None:
        """Return whether the hand of an arm is at a pose.

        Args:
            pose: The pose, (7,): position in m from the base, x forwards, z up, and quaternion
                xyzw.
            arm: The index of the arm.
        """
        x, y, z, *quaternion = np.round(pose.astype(float), 2).tolist()
        pose_text = (
            f"{x} m in front of the base, {y} m to its left, {z} m above it, with the "
            f"quaternion xyzw {quaternion}"
        )
        return _ask(f"Is the hand of arm {arm + 1} at this pose: {pose_text}?")


def _ask(question: str) -> bool | None:
    """Ask a question at the terminal; return None if the operator cannot tell."""
    try:
        answer = input(f"{question} [y/n, Enter: cannot tell] ").strip().lower()
    except EOFError:
        return None
    return {"y": True, "n": False}.get(answer[:1])


@dataclass(frozen=True)
class Finding:
    """A violation that a check found."""

    check: str  # a key of CHECKS
    got: str  # the measurement
    want: str  # the right value
    cure: str  # what to change
    when: str  # "before any motion", or the motion at which it was found

    def __str__(self) -> str:
        return (
            f"{self.check}: expected {self.want}, got {self.got}; {self.cure} (found {self.when})"
        )


@dataclass
class RobotReport:
    """The result of an examination: findings, passed and skipped checks, figures and pictures."""

    findings: list[Finding] = field(default_factory=list)
    passed: list[str] = field(default_factory=list)  # keys of CHECKS
    skipped: dict[str, str] = field(default_factory=dict)  # the reason by key of CHECKS
    figures: dict[str, float] = field(default_factory=dict)  # measurements; the names have units
    pictures: dict[str, np.ndarray] = field(default_factory=dict)  # (H, W, 3) uint8 by title
    # The missing declarations without which the motion cannot be checked; "" if there are none.
    undeclared: str = ""
    robot: str = ""  # the name of the robot
    at: float = field(default_factory=time.time)  # s since 1970

    @property
    def ok(self) -> bool:
        """Whether no check found a violation, and the robot declares what the checks need."""
        return not self.findings and not self.undeclared

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        if self.findings:
            return f"FOUND {len(self.findings)}: do not let a policy move this robot"
        if self.undeclared:
            return f"NOT CHECKED: {self.undeclared}"
        if self.skipped:
            return f"nothing found; {len(self.skipped)} of {len(CHECKS)} checks were not made"
        return "nothing found in any check"

    def lines(self) -> list[str]:
        """Return the report as lines of text; the last line is the verdict."""
        names_by_reason: dict[str, list[str]] = {}
        for name, reason in self.skipped.items():
            names_by_reason.setdefault(reason, []).append(name)

        lines = [f"FOUND {finding}" for finding in self.findings]
        lines += [f"ok {name}: {CHECKS[name]}" for name in self.passed]
        for reason, names in names_by_reason.items():
            lines.append(f"not checked {', '.join(names)}: {reason}")
        lines += [f"{name}: {value:.3g}" for name, value in self.figures.items()]
        return [*lines, self.verdict]

    def write(self, file: str | Path) -> None:
        """Write the report with its pictures as one HTML page, which needs no network."""
        date = time.strftime("%Y-%m-%d %H:%M", time.localtime(self.at))
        if self.findings:
            colour = "#b00020"  # red
        elif self.undeclared:
            colour = "#8a5a00"  # amber
        else:
            colour = "#1b6e1b"  # green
        style = "body{font:16px/1.5 sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
        style += f"h2{{color:{colour}}}figure{{display:inline-block;margin:8px}}img{{height:240px}}"

        title = f"Check of {html.escape(self.robot)}"
        page = f"<!doctype html><meta charset=utf-8><title>{title}</title>"
        page += f"<style>{style}</style><h1>{title}</h1>"
        page += f"<h2>{html.escape(self.verdict)}</h2><p>{date}</p>"
        items = [f"<li>{html.escape(line)}</li>" for line in self.lines()[:-1]]
        page += f"<ul>{''.join(items)}</ul>"

        for caption, picture in self.pictures.items():
            url = data_url("image/jpeg", encode_jpeg(picture))
            page += (
                f'<figure><img src="{url}"><figcaption>{html.escape(caption)}</figcaption></figure>'
            )

        Path(file).write_text(page, encoding="utf-8")


def examine(
    robot: Robot,
    *,
    contract: Contract | None = None,
    operator: Operator | None = None,
    hz: float | None = None,
    latency_s: float = 0.4,
    clock: Any = time,
) -> RobotReport:
    """Check a robot, first at rest, then with small moves of one joint at a time; the operator
    agrees to each move.

    A finding at rest prevents all motion; a finding in motion stops the robot and ends the check.

    Args:
        robot: The robot, at rest and away from the limits of its joints.
        contract: The contract of observations and actions; default: the robot's own. Moves need
            `action.dim`, and whether actions are relative.
        operator: The person at the robot; without one, nothing moves.
        hz: The control rate, Hz; default: the contract's, else 50.
        latency_s: The longest time from a command to its measured motion, s.
        clock: The module `time`, or the `SimulatedClock` of a simulated robot.

    Returns:
        The findings, and the checks that passed or were skipped.
    """
    contract = contract or contract_of(robot)
    period_s = 1 / (hz or contract.control_hz or 50.0)
    report = RobotReport(robot=type(robot).__name__)
    suite = _Suite(robot, contract, operator, period_s, latency_s, clock, report)

    try:
        suite.at_rest()
        suite.in_motion()
    except _FoundInMotionError:
        pass
    except InvalidObservation as error:
        suite.find(
            "observation",
            str(error),
            "an observation that fits the contract",
            "correct observe",
            ends=False,
        )
    finally:
        robot.stop()

    reason = "an earlier check found something" if suite.report.findings else "nothing moved"
    suite.skip_others(reason)
    return suite.report


class _FoundInMotionError(Exception):
    """Ends the check after a finding in motion."""


@dataclass
class _Suite:
    """The checks of one robot."""

    _robot: Robot
    _contract: Contract
    _operator: Operator | None
    _period_s: float
    _latency_s: float
    _clock: Any
    report: RobotReport = field(default_factory=RobotReport)
    _motion: str = ""  # the present motion; empty at rest
    _stamp_s: float = -np.inf  # the last time stamp, s since 1970
    _stamps_are_right: bool = True
    _observe_s: list[float] = field(default_factory=list)  # durations of the calls of `observe`, s
    _apply_s: list[float] = field(default_factory=list)  # durations of the calls of `apply`, s
    _lags_s: list[float] = field(default_factory=list)  # times from a command to its motion, s
    _command: np.ndarray = field(default_factory=lambda: np.zeros(0))  # the last action
    _layout: _Layout | None = None

    def find(self, check: str, got: str, want: str, cure: str, *, ends: bool = True) -> None:
        """Report a finding.

        Args:
            check: The check, a key of CHECKS.
            got: The measurement.
            want: The right value.
            cure: What to change.
            ends: Whether a finding in motion stops the robot and ends the check.
        """
        when = f"during {self._motion}" if self._motion else "before any motion"
        self.report.findings.append(Finding(check, got, want, cure, when))
        if ends and self._motion:
            self._robot.stop()
            raise _FoundInMotionError

    def at_rest(self) -> None:
        """Run the checks for which the robot does not move."""
        first_obs = self._observe()
        self._layout = _Layout.find(self._robot, self._contract, first_obs)
        check_observation(first_obs, self._contract)
        if self._layout is None or self._contract.action.relative is None:
            self.report.undeclared = _undeclared(self._contract)
        if self._contract == Contract():
            self.report.skipped["observation"] = _DECLARE
        self._pass("observation")

        names = getattr(self._robot, "joint_names", ())
        for number, ours, theirs in reordered(names, self._contract.action.names or ())[:1]:
            cure = "use the contract's order of joints in actions and in the state"
            self.find(
                "order",
                f"{ours!r} as joint {number} of the arm",
                f"{theirs!r}, as the contract declares",
                cure,
            )

        last_obs = first_obs
        for _ in range(20):
            self._clock.sleep(self._period_s)
            last_obs = self._observe()
        if self._stamps_are_right:
            self._pass("clock")

        median_ms = 1e3 * float(np.quantile(self._observe_s, 0.5))
        p99_ms = 1e3 * float(np.quantile(self._observe_s, 0.99))
        self.report.figures |= {"observe p50, ms": median_ms, "observe p99, ms": p99_ms}
        if median_ms > 500 * self._period_s:
            limit = f"at most {500 * self._period_s:.3g} ms, half of a tick"
            self.find(
                "rate",
                f"{median_ms:.3g} ms for observe",
                limit,
                "read the cameras and the bus in separate threads",
            )

        self._check_units(last_obs)
        self._check_limits(last_obs)
        self._check_stop()
        self._check_new_pictures()
        self._check_cameras()
        self._check_place(last_obs)

    def in_motion(self) -> None:
        """Move one joint at a time, then the grippers, unless a finding or another reason forbids
        motion.
        """
        layout = self._layout
        if self.report.findings:
            return
        if layout is None or self._contract.action.relative is None:
            self.skip_others(_DECLARE)
            return
        if not self._ask_to_move("a command to the present pose, which should move nothing"):
            return

        self._check_meaning(layout)
        self._pass("meaning", "blocking")

        for joint, name in enumerate(layout.names):
            if not self._ask_to_move(f"a move of {name} by {layout.step:g} {layout.unit} and back"):
                return
            self._move(layout, joint, name)
            if joint == 0:
                self._check_single_commands(layout, name)
                self._check_stop_in_motion(layout, name)

        self._pass("order", "sign", "size", "latency", "rate", "pose", "commands", "stop")
        self.report.figures["command to measured motion, ms"] = 1e3 * float(np.median(self._lags_s))
        self._check_grippers(layout)

    def skip_others(self, reason: str) -> None:
        """List all checks without a result as skipped, for this reason."""
        done = {*self.report.passed, *(finding.check for finding in self.report.findings)}
        for name in CHECKS:
            if name not in done:
                self.report.skipped.setdefault(name, reason)

    def _ask_to_move(self, motion: str) -> bool:
        """Return whether the operator agrees to a motion; if not, skip the other checks."""
        agrees = self._operator is not None and self._operator.agrees(motion)
        self._motion = motion if agrees else ""
        if self._operator is None:
            self.skip_others("no operator agreed to a motion")
        elif not agrees and not self._operator.may_move:
            self.skip_others("nothing may move without --move")
        elif not agrees:
            self.skip_others(f"the operator did not agree to {motion}")
        return agrees

    def _pass(self, *checks: str) -> None:
        """List checks as passed, unless they have a finding or were skipped."""
        not_passed = {finding.check for finding in self.report.findings}
        not_passed |= self.report.skipped.keys()
        for check in checks:
            if check not in not_passed and check not in self.report.passed:
                self.report.passed.append(check)

    def _observe(self) -> Obs:
        """Return an observation, and check its time stamp."""
        began_s = self._clock.monotonic()
        obs = self._robot.observe()
        self._observe_s.append(self._clock.monotonic() - began_s)

        stamp_s = obs.info.get(CAPTURED)
        if stamp_s is None:
            self.report.skipped.setdefault("clock", f"observations have no {CAPTURED!r}")
        elif self._stamps_are_right:
            ahead_s = stamp_s - self._clock.time()
            back_s = self._stamp_s - stamp_s
            self._stamp_s = stamp_s
            if back_s > 0 or not _SKEW_S[0] <= ahead_s <= _SKEW_S[1]:
                self._stamps_are_right = False
                if back_s > 0:
                    got = f"a time stamp {back_s:.3g} s before the last one"
                else:
                    got = f"a time stamp that is {ahead_s:+.3g} s off"
                cure = (
                    "use time.time() of this machine when the first sensor is read, or "
                    "synchronize the clocks"
                )
                self.find("clock", got, "the time at which the first sensor was read", cure)
        return obs

    def _apply(self, action: np.ndarray) -> None:
        """Command an action, and check that `apply` does not wait."""
        raise_dropped()  # after a signal that ends the program, nothing moves
        self._command = action
        began_s = self._clock.monotonic()
        self._robot.apply(action.astype(np.float32))
        took_s = self._clock.monotonic() - began_s
        self._apply_s.append(took_s)

        limit_s = max(0.005, self._period_s / 4)
        if np.median(self._apply_s) > limit_s:
            limit = f"at most {1e3 * limit_s:.3g} ms"
            cure = "send the command and return; do not wait until the arm is there"
            self.find("blocking", f"{1e3 * took_s:.3g} ms for apply", limit, cure)

    def _check_units(self, obs: Obs) -> None:
        """Check the units of joints, positions, quaternions and the gripper."""
        unclear: list[str] = []  # parts whose numbers would be valid in several units
        for name, values in obs.state.items():
            spec = (self._contract.state or {}).get(name)
            unit = (spec.unit if spec else None) or "rad"
            base_name = name.rpartition("/")[2]  # the name of the part without the name of the arm

            if base_name == "joints":
                largest = float(np.abs(values).max(initial=0.0))
                if unit == "rad" and largest > _MOST_RAD:
                    got = f"{largest:.4g} in {name!r}, more than a full turn"
                    cure = "convert degrees by np.deg2rad, in observe and in apply"
                    self.find("units", got, "rad", cure)
                elif largest < _NEAR_ZERO.get(unit, _MOST_RAD):
                    unclear.append(f"{name!r} (at most {largest:.2g} {unit})")

            if base_name in ("tquat", "xyzrpy"):
                farthest = np.abs(values[:3]).max()
                if farthest > _MOST_M:
                    got = f"{farthest:.4g} in {name!r}"
                    self.find("units", got, "m", "divide millimetres by 1000")

            if base_name == "tquat":
                length = np.linalg.norm(values[3:])
                if abs(length - 1) > 0.01:
                    got = f"a quaternion of length {length:.3g} in {name!r}"
                    self.find(
                        "units", got, "1", "return the position, followed by the quaternion xyzw"
                    )

        if obs.gripper is not None and not 0 <= obs.gripper <= 1:
            self.find(
                "units",
                f"a gripper of {obs.gripper:.3g}",
                "[0, 1], 1 = open",
                "scale the opening with the values of the closed and the open gripper",
            )

        if unclear and not any(finding.check == "units" for finding in self.report.findings):
            self.report.skipped["units"] = (
                f"all joints are near 0, where units look alike: {', '.join(unclear)}; move the "
                "arm by hand, and check again"
            )
        self._pass("units")

    def _check_limits(self, obs: Obs) -> None:
        """Check that the joints are within their limits."""
        layout = self._layout
        if any(finding.check == "units" for finding in self.report.findings):
            return
        if layout is None or np.isinf(layout.limits).all():
            self.report.skipped["limits"] = (
                "the robot has no `joint_limits`, or no state of its joints"
            )
            return

        measured_joints = layout.measured(obs)
        for name, measured, (low, high) in zip(
            layout.names, measured_joints, layout.limits, strict=True
        ):
            if not low <= measured <= high:
                self.find(
                    "limits",
                    f"{name} at {measured:.4g}",
                    f"[{low:.4g}, {high:.4g}]",
                    "declare the limits of this arm, in the order and unit of its joints",
                )
                break

        self._pass("limits")

    def _check_stop(self) -> None:
        """Check that `stop` returns at once, can be repeated, and works from another thread."""

        def stop_from_thread() -> None:
            """Call `stop` on another thread."""
            with ThreadPoolExecutor(1) as thread:
                thread.submit(self._robot.stop).result()

        calls = (
            ("", self._robot.stop),
            (" again", self._robot.stop),
            (" from a thread", stop_from_thread),
        )
        for occasion, call in calls:
            began_s = self._clock.monotonic()
            try:
                call()
            except Exception as error:  # noqa: BLE001 - any error of the robot is a finding
                self.find(
                    "stop",
                    f"{error!r} from stop{occasion}",
                    "no error in any state",
                    "make stop safe to repeat",
                )
                return

            took_s = self._clock.monotonic() - began_s
            if took_s > _STOP_S:
                self.find(
                    "stop",
                    f"{took_s:.3g} s for stop{occasion}",
                    f"at most {_STOP_S} s",
                    "send the stop and return",
                )
                return

    def _check_new_pictures(self) -> None:
        """Find cameras that repeat one picture; the noise of a sensor changes each picture, even
        if the scene does not change.
        """
        if getattr(self._robot, "simulated", False):
            return
        if getattr(self._robot, "dates_pictures", False):
            self._check_new_dates()
            return

        first = {name: picture.copy() for name, picture in self._observe().cameras.items()}
        unchanged = set(first)  # names of cameras
        began_s = self._clock.monotonic()
        while unchanged and self._clock.monotonic() - began_s < _FROZEN_S:
            self._clock.sleep(self._period_s)
            pictures = self._observe().cameras
            for name in tuple(unchanged):
                if name not in pictures or not np.array_equal(pictures[name], first[name]):
                    unchanged.remove(name)

        for name in sorted(unchanged):
            got = f"the same picture of {name!r}, to the bit, for {_FROZEN_S:g} s"
            cure = (
                "the camera hangs, or observe returns a stored picture: restart it, and read each "
                "frame once; a simulated robot declares `simulated = True`"
            )
            self.find(
                "cameras",
                got,
                "new pictures, which differ at least in the noise of the sensor",
                cure,
            )

    def _check_new_dates(self) -> None:
        """Find a sensor whose time stamps do not advance; a simulation may render one picture
        repeatedly.
        """
        began_s = self._clock.monotonic()
        began_at = self._clock.time()
        while self._observe().info[CAPTURED] < began_at:
            if self._clock.monotonic() - began_s > _FROZEN_S:
                reason = getattr(self._robot, "holds", None)
                got = reason or f"no reading of a sensor that is newer than {_FROZEN_S:g} s"
                self.find(
                    "cameras", got, "new pictures and states", "restart the driver of this sensor"
                )
                return
            self._clock.sleep(self._period_s)

    def _check_cameras(self) -> None:
        """Check each camera with a red card that the operator holds."""
        if any(finding.check == "cameras" for finding in self.report.findings):
            return

        before = self._observe().cameras
        self.report.pictures |= before
        for camera in before:
            if self._operator is None or not self._operator.holds_card(camera):
                self.report.skipped["cameras"] = "nobody could hold the red card"
                return

            self._clock.sleep(0.3)
            after = self._observe().cameras
            self.report.pictures[f"{camera}, with the red card in the upper left"] = after[camera]
            cards = {name: _find_card(before[name], after[name]) for name in before}
            self._judge_card(camera, cards)

        if not before:
            self.report.skipped["cameras"] = "there is none"
        elif self._operator is not None:
            self._operator.holds_card(None)

        self._pass("cameras")

    def _judge_card(self, camera: str, cards: dict[str, _Card | None]) -> None:
        """Check the card in the picture of one camera.

        Args:
            camera: The camera.
            cards: The card in the picture of each camera, by name.
        """
        card = cards[camera]
        want = f"the card, red, in the upper left of {camera!r}"

        other_cameras = []
        for name, other_card in cards.items():
            if name != camera and other_card is not None and other_card.share > 0.004:
                other_cameras.append(name)

        if card is None and other_cameras:
            self.find(
                "cameras",
                f"the card for {camera!r} in {other_cameras[0]!r}",
                want,
                "exchange the names of the cameras",
            )
        elif card is None:
            cure = "the camera hangs or returns old pictures; restart it, and read each frame once"
            self.find("cameras", f"no change in {camera!r}, a frozen picture", want, cure)
        elif not card.red:
            self.find(
                "cameras",
                f"a blue card in {camera!r}",
                want,
                "return RGB: image[..., ::-1] of OpenCV's BGR",
            )
        elif card.x > 0.5 or card.y > 0.5:
            got = (
                f"the card at {100 * card.x:.0f} % from the left and {100 * card.y:.0f} % from "
                f"the top of {camera!r}"
            )
            self.find(
                "cameras",
                got,
                want,
                "rotate or flip the picture in observe: it must be upright, not mirrored",
            )

    def _check_place(self, obs: Obs) -> None:
        """Check that the operator sees each hand at its reported pose."""
        for number, arm in enumerate(self._contract.action.arms or ("",)):
            pose = obs.state.get(arm_part(arm, "tquat"))
            sees: bool | None = None
            if pose is not None and self._operator is not None:
                sees = self._operator.sees_hand(pose, number)

            if pose is None or sees is None:
                self.report.skipped["place"] = (
                    "observations have no 'tquat', or the operator cannot tell"
                )
            elif not sees and not self.report.findings:
                position = np.round(pose[:3], 2)
                quaternion = np.round(pose[3:], 2)
                got = f"the hand at {position} m with the quaternion {quaternion}, where it is not"
                cure = (
                    "return the pose in the frame of the arm's base, x forwards and z up, and the "
                    "quaternion as xyzw"
                )
                self.find("place", got, "the pose that the operator sees", cure)

        self._pass("place")

    def _hold_command(self, layout: _Layout, obs: Obs) -> np.ndarray:
        """Return the action that should move nothing."""
        action = np.zeros(len(layout.joints) + len(layout.grippers))
        if not layout.relative:
            action[layout.joints] = layout.measured(obs)

        spec = self._contract.action
        if layout.grippers and spec.gripper_open is not None and spec.gripper_closed is not None:
            opening = 1.0 if obs.gripper is None else obs.gripper
            width = spec.gripper_open - spec.gripper_closed
            action[layout.grippers] = spec.gripper_closed + opening * width

        return action

    def _check_meaning(self, layout: _Layout) -> None:
        """Check that a command to the present pose moves nothing."""
        obs = self._observe()
        start = layout.measured(obs)
        self._apply(self._hold_command(layout, obs))
        for _ in range(round((0.5 + self._latency_s) / 0.01)):
            self._clock.sleep(0.01)
            moved = layout.measured(self._observe()) - start
            if np.abs(moved).max() > _RUNAWAY * layout.step:
                joint = int(np.argmax(np.abs(moved)))
                got = f"a motion of {layout.names[joint]} by {moved[joint]:+.3g} or more"
                other_meaning = "absolute targets" if layout.relative else "deltas"
                cure = (
                    f"the arm expects {other_meaning}, or other units: correct apply, or "
                    "action.delta of the contract"
                )
                self.find("meaning", got, "no motion at a command to the present pose", cure)

    def _ramp(self, layout: _Layout, joint: int, change: float) -> list[tuple[float, np.ndarray]]:
        """Move a joint within `_RAMP_S`, and measure it until the motion is over.

        Args:
            layout: The numbers of an action.
            joint: The joint.
            change: The change of its position.

        Returns:
            The times, s, and the measured joints, (D,), at each tick.
        """
        base = layout.measured(self._observe())
        ticks = max(1, round(_RAMP_S / self._period_s))

        readings = []
        for tick in range(1, ticks + round(_HOLD_S / self._period_s) + 1):
            if tick <= ticks:
                self._apply(layout.changed(self._command, joint, change / ticks))
            self._clock.sleep(self._period_s)
            measured = layout.measured(self._observe())
            readings.append((self._clock.monotonic(), measured))
            if np.abs(measured - base).max() > _RUNAWAY * layout.step:
                self._judge_move(layout, joint, change, measured - base)
        return readings

    def _move(self, layout: _Layout, joint: int, name: str) -> None:
        """Move a joint by a small step and back, and check its motion."""
        before = self._observe()
        base = layout.measured(before)
        began_s = self._clock.monotonic()

        # Move to the positive side unless the upper limit is too close.
        has_room = base[joint] + 2 * layout.step < layout.limits[joint][1]
        change = layout.step if has_room else -layout.step
        readings = self._ramp(layout, joint, change)
        after = self._observe()
        moved = layout.measured(after) - base
        self._judge_move(layout, joint, change, moved)

        saw: bool | None = None
        if self._operator is not None:
            saw = self._operator.saw_joint(name, 1 if has_room else -1)
        if saw is None:
            reason = (
                f"command and reading agree, but the operator could not tell whether {name} moved"
            )
            self.report.skipped |= {"order": reason, "sign": reason}
        if saw is False:
            cure = "correct the order or the sign of the joints, in observe and in apply"
            got = f"another joint, or another direction, when {name} was commanded to move"
            self.find("order", got, f"{name} alone, {change:+g}", cure)

        # The joint's lag: from the middle of the commanded ramp to half of the measured change.
        half_way_s = np.inf
        for time_s, measured in readings:
            if (measured[joint] - base[joint]) / change >= 0.5:
                half_way_s = time_s
                break
        lag_s = half_way_s - began_s - _RAMP_S / 2
        self._lags_s.append(lag_s)
        if lag_s > self._latency_s:
            got = f"{lag_s:.3g} s from the command of {name} to its measured motion"
            cure = (
                "read the newest state, without a queue; if the arm itself is slow, set latency_s"
            )
            self.find("latency", got, f"at most {self._latency_s} s", cure)

        positions = [measured[joint] for _, measured in readings]
        ticks = round(_RAMP_S / self._period_s)
        # An arm that is read at the control rate has a new position at each tick.
        changes = int(np.count_nonzero(np.abs(np.diff(positions)) > 1e-3 * layout.step))
        if changes < ticks / 2:
            got = f"{changes} new readings of {name} in a move of {ticks} ticks"
            cure = (
                "run the arm's own loop, and read it, at the control rate, or lower the rate (hz)"
            )
            self.find("rate", got, f"one per tick, {1 / self._period_s:.3g} Hz", cure)

        self._judge_pose(layout, joint, before, after)

        self._ramp(layout, joint, -change)
        deviation = layout.measured(self._observe()) - base
        if np.abs(deviation).max() > layout.step / 2:
            got = f"a deviation of {np.abs(deviation).max():.3g} after {name} moved back"
            self.find("size", got, "the pose before", "check the arm's controller")

    def _judge_move(self, layout: _Layout, joint: int, change: float, moved: np.ndarray) -> None:
        """Compare the measured changes of all joints, (D,), with the commanded change of one
        joint.
        """
        name = layout.names[joint]
        moved_most = int(np.argmax(np.abs(moved)))
        ratio = float(moved[joint] / change)

        if np.abs(moved).max() < 0.3 * layout.step:
            cure = "check that torque is on, and that apply sends each command"
            self.find("size", f"no motion of any joint for {name}", f"{change:+g}", cure)
        elif moved_most != joint:
            got = (
                f"{layout.names[moved_most]} moved by {moved[moved_most]:+.3g} when {name} was "
                "commanded"
            )
            self.find(
                "order",
                got,
                f"{name} alone",
                "use the same order of joints in actions and in the state",
            )
        elif ratio < 0:
            got = f"{name} moved by {moved[joint]:+.3g} for {change:+g}"
            self.find(
                "sign",
                got,
                "the same sign",
                "invert the joint in observe or in apply, as the policy's data do",
            )
        elif not 0.5 < ratio < 1.5:
            got = f"{name} moved by {moved[joint]:+.3g} for {change:+g}"
            cure = (
                "check the units of commands and readings, and that each command is executed once"
            )
            self.find("size", got, f"{change:+g}", cure)

    def _judge_pose(self, layout: _Layout, joint: int, before: Obs, after: Obs) -> None:
        """Check that the pose of the hand turned by the joint's angle, and moved about the joint's
        axis.
        """
        key = layout.pose_of[joint]
        if key is None or layout.unit not in ("rad", "deg"):
            self.report.skipped["pose"] = "observations have no 'tquat', the pose of the hand"
            return

        path = after.state[key][:3] - before.state[key][:3]
        q0 = before.state[key][3:].astype(float)
        q1 = after.state[key][3:].astype(float)
        # The quaternion of the rotation: q1 times the inverse of q0.
        axis = q0[3] * q1[:3] - q1[3] * q0[:3] - np.cross(q1[:3], q0[:3])
        sine = np.linalg.norm(axis)
        angle = 2 * np.arctan2(sine, abs(q1 @ q0))

        change = abs(layout.measured(after)[joint] - layout.measured(before)[joint])
        if layout.unit == "deg":
            change = np.deg2rad(change)
        if abs(angle - change) > 0.3 * change + 0.01:
            got = (
                f"the hand turned by {angle:.3g} rad for {change:.3g} rad of {layout.names[joint]}"
            )
            self.find(
                "pose",
                got,
                "the same angle",
                "correct the rotation of the pose, or the unit of the joints",
            )

        # The other joints may yield by 1 mm and a sixth of the hand's path.
        along = abs(float(path @ axis)) / max(1e-9, float(sine))
        if along > 0.001 + float(np.linalg.norm(path)) / 6:
            got = f"a hand that moved {1e3 * along:.2g} mm along the axis about which it turned"
            self.find(
                "pose",
                got,
                "a motion about the joint's axis",
                "return the quaternion as xyzw, not as wxyz",
            )

    def _check_single_commands(self, layout: _Layout, name: str) -> None:
        """Check that the first joint moves at each of six single commands."""
        half = layout.step / 2
        for number in range(6):
            before = layout.measured(self._observe())[0]
            change = half if number % 2 == 0 else -half
            self._apply(layout.changed(self._command, 0, change))
            self._clock.sleep(2 * self._latency_s)
            if abs(layout.measured(self._observe())[0] - before) < 0.4 * half:
                got = f"no motion of {name} at command {number + 1} of 6 single commands"
                self.find(
                    "commands",
                    got,
                    "a motion at each command",
                    "commands are dropped: check bus and network",
                )

    def _check_stop_in_motion(self, layout: _Layout, name: str) -> None:
        """Check that `stop` ends a motion of the first joint."""
        before = layout.measured(self._observe())[0]
        self._apply(layout.changed(self._command, 0, layout.step))
        self._robot.stop()
        self._clock.sleep(2 * self._latency_s)

        moved = abs(layout.measured(self._observe())[0] - before)
        if moved > layout.step / 2:
            got = f"{name} moved on by {moved:.3g} after stop"
            self.find(
                "stop",
                got,
                "rest at once",
                "in stop, make the measured pose the target, and drop queued commands",
            )

        self._command = self._hold_command(layout, self._observe())

    def _check_grippers(self, layout: _Layout) -> None:
        """Check that the grippers close when they are commanded to close."""
        spec = self._contract.action
        obs = self._observe()
        if not layout.grippers or obs.gripper is None or spec.gripper_closed is None:
            self.report.skipped["gripper"] = "the contract declares no gripper"
            return
        if not self._ask_to_move("closing and opening the gripper"):
            return

        action = self._hold_command(layout, obs)

        def opening_after(goal: float | None) -> float:
            """Command an opening, and return the measured opening."""
            action[layout.grippers] = goal
            self._apply(action)
            self._clock.sleep(2.0)
            return self._observe().gripper or 0.0

        before = opening_after(spec.gripper_open)
        after = opening_after(spec.gripper_closed)

        saw = None if self._operator is None else self._operator.saw_closing()
        if saw is None:
            self.report.skipped["gripper"] = (
                "the operator could not tell whether the gripper closed"
            )
        if after > before - 0.3 or saw is False:
            got = f"an opening of {before:.2g} before and {after:.2g} after the command to close"
            cure = (
                "exchange gripper_open and gripper_closed of the contract, and return 1 for an "
                "open gripper in observe"
            )
            self.find("gripper", got, "a gripper that closes, and a smaller opening", cure)

        opening_after(spec.gripper_open)
        self._pass("gripper")


def _undeclared(contract: Contract) -> str:
    """Return the declarations that the check of the motion needs and a contract lacks, in words."""
    action = contract.action
    missing = [name for name in ("dim", "space", "delta") if getattr(action, name) is None]
    if missing:
        reason = f"its `action` has no {', '.join(missing)}"
    else:
        reason = "its state has no `joints` of the size of an action, or its actions are not joints"
    return (
        f"the motion cannot be checked, as {reason}. Give the class a `contract`, such as "
        "Contract(state={'joints': StateSpec(6, 'rad')}, action=ActionSpec(dim=6, space='joint', "
        "delta=False)), or check it against the contract of a policy (--policy URL). A robot "
        "behind topics of ROS never declares `space`, so it needs --policy; see docs/arms.md"
    )


@dataclass(frozen=True)
class _Layout:
    """The numbers of an action, and the parts of the state that measure them."""

    names: list[str]  # the names of the joints
    limits: np.ndarray  # limits of the joints, (D, 2); infinite if the robot has no `joint_limits`
    joints: list[int]  # the indices of the joints in an action
    grippers: list[int]  # the indices of the grippers in an action
    joint_parts: list[str]  # the parts of the state that together contain the joints
    pose_of: list[str | None]  # for each joint, the part with the pose of the hand of its arm
    unit: str  # unit of the joints
    relative: bool  # whether actions are relative

    @classmethod
    def find(cls, robot: Robot, contract: Contract, obs: Obs) -> _Layout | None:
        """Return the layout of a robot's actions; None if an action does not consist of the joints
        of each arm, each followed by the arm's gripper.
        """
        action: ActionSpec = contract.action
        if action.space not in (None, "joint") or action.dim is None:
            return None

        keys = [arm_part(arm, "joints") for arm in action.arms or ("",)]
        joint_parts = [key for key in keys if key in obs.state]
        counts = [len(obs.state[key]) for key in joint_parts]
        grippers_per_arm = (action.dim - sum(counts)) // max(1, len(joint_parts))
        dim = sum(counts) + grippers_per_arm * len(joint_parts)
        if not joint_parts or grippers_per_arm not in (0, 1) or dim != action.dim:
            return None

        grippers: list[int] = []
        if grippers_per_arm:
            # The gripper is the last number of an arm.
            arm_ends = np.cumsum(counts) + np.arange(1, len(joint_parts) + 1)
            grippers = [int(arm_end) - 1 for arm_end in arm_ends]
        joints = [index for index in range(action.dim) if index not in grippers]

        pose_of: list[str | None] = []
        for key, count in zip(joint_parts, counts, strict=True):
            pose_key = key.replace("joints", "tquat")
            pose_of += [pose_key if pose_key in obs.state else None] * count

        names = list(getattr(robot, "joint_names", ()))
        if len(names) != len(joints):
            names = [f"joint {number}" for number in range(len(joints))]

        unlimited = [(-np.inf, np.inf)] * len(joints)
        limits = np.asarray(getattr(robot, "joint_limits", unlimited))
        if limits.shape != (len(joints), 2):
            raise ConfigError(
                f"joint_limits: expected shape ({len(joints)}, 2), a low and a high for each "
                f"joint, got {limits.shape}"
            )

        spec = (contract.state or {}).get(joint_parts[0]) or StateSpec()
        return cls(
            names=names,
            limits=limits,
            joints=joints,
            grippers=grippers,
            joint_parts=joint_parts,
            pose_of=pose_of,
            unit=spec.unit or "rad",
            relative=bool(action.relative),
        )

    @property
    def step(self) -> float:
        """The size of a small move, in the unit of the joints."""
        return _STEPS.get(self.unit, _OTHER_STEP)

    def changed(self, last: np.ndarray, joint: int, change: float) -> np.ndarray:
        """Return the action that moves one joint from the target of the last action.

        Args:
            last: The last action, (dim,).
            joint: The joint.
            change: The change of its position.
        """
        action = last.copy()
        if self.relative:
            action[self.joints] = 0
        action[self.joints[joint]] += change
        return action

    def measured(self, obs: Obs) -> np.ndarray:
        """Return the measured joints in the order of an action, (D,)."""
        return np.concatenate([obs.state[name] for name in self.joint_parts]).astype(float)


@dataclass(frozen=True)
class _Card:
    """A card in a picture."""

    red: bool  # whether the card is red; otherwise it is blue
    x: float  # x of the middle of the card, in [0, 1] from the left
    y: float  # y of the middle of the card, in [0, 1] from the top
    share: float  # the card's share of all pixels


def _find_card(before: np.ndarray, after: np.ndarray) -> _Card | None:
    """Find a card in a picture: the pixels that became red, or blue if red and blue are exchanged.

    Args:
        before: The picture without the card, (H, W, 3) uint8.
        after: The picture with the card, (H, W, 3) uint8.

    Returns:
        The card; None if no card is found.
    """
    red, green, blue = np.moveaxis(after.astype(int), -1, 0)
    changed = np.abs(after.astype(int) - before).max(-1) > _RED
    became_red = changed & (red - np.maximum(green, blue) > _RED)
    became_blue = changed & (blue - np.maximum(green, red) > _RED)
    larger = max([became_red, became_blue], key=np.count_nonzero)
    if np.count_nonzero(larger) < 1e-3 * larger.size:
        return None

    rows, columns = np.nonzero(larger)
    height, width = larger.shape
    return _Card(
        red=larger is became_red,
        x=columns.mean() / width,
        y=rows.mean() / height,
        share=len(rows) / larger.size,
    )


def arm_part(arm: str, name: str) -> str:
    """Return the name of a part of the state of an arm; the arm's name is "" if the robot has only
    one.
    """
    return f"{arm}/{name}" if arm else name
