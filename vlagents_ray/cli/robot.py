"""Drive a robot with a served policy in the control loop, and print a report at the end.

With --env, drive a simulation instead: with a policy, with an operator, or with a policy that an
operator corrects.

The API key of the server is read from the variable VLAGENTS_RAY_API_KEY, and the file of your own
CA from SSL_CERT_FILE.

Exit status: 0 if every tick had an action of the policy, 1 if some had none, 3 if more than half
had none, 2 if the loop could not run, or could not record.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import signal
import sys
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, get_args

from vlagents_ray.chunking.buffer import ENSEMBLE, MERGES
from vlagents_ray.chunking.choice import WAIT_S, Choice, ChosenMode, choose_for, measured_delay
from vlagents_ray.chunking.control import RobotControl
from vlagents_ray.chunking.player import ChunkPlayer
from vlagents_ray.chunking.timeliness import in_words
from vlagents_ray.cli.arguments import CommandParser, number, one_of, parse_all
from vlagents_ray.cli.examples import EXAMPLES
from vlagents_ray.cli.help_page import HelpPage, HelpPanel, HelpRow, error_line
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.commands import CommandInbox
from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, VLAgentsError, printable
from vlagents_ray.interface import Agent
from vlagents_ray.naming import did_you_mean
from vlagents_ray.registry import entries, names, not_installed, pip_install, registered_function
from vlagents_ray.robot.fit import Fit, Trained
from vlagents_ray.robot.guard import SOFT_START_S, Guard, measured_state
from vlagents_ray.robot.leaders import Leader, OpenLeader, leader_named
from vlagents_ray.robot.limits import MotionLimits
from vlagents_ray.robot.loop import (
    LoopOptions,
    LoopReport,
    Restart,
    Robot,
    contract_of,
    fit_of,
    opened,
    robot_factory,
    robot_watchdog,
    run_loop,
)
from vlagents_ray.robot.record import Recorder
from vlagents_ray.robot.simulated import SimulatedRobot
from vlagents_ray.robot.terminal import typed_keys
from vlagents_ray.robot.watchdog import Watchdog
from vlagents_ray.signals import END_SIGNALS, ended_by_signals
from vlagents_ray.viewers import open_viewer

logger = logging.getLogger(__name__)
MOSTLY_SAFE = 3  # exit status
_HZ = 50.0  # default control rate of a robot
_MOST_HZ = 10_000.0  # maximum control rate; no arm and no loop in Python is faster
_LABELS = {"y": "success", "n": "failure"}
KEYS = (
    "keys: p pauses and continues; y (success), n (failure), x (discard) and q end the run and "
    "stop the robot; c or Enter restarts it after a stop"
)
# Messages for options that users may expect. A key in an option would be visible in the list of
# processes.
_OF_KEYS = "the API key is read from a variable: export VLAGENTS_RAY_API_KEY=vlr_..."
_OF_CAS = "the file of your CA is read from a variable: export SSL_CERT_FILE=ca.pem"
_CURES = {
    "--api-key": _OF_KEYS,
    "--key": _OF_KEYS,
    "--ca": _OF_CAS,
    "--cacert": _OF_CAS,
    "--tls-ca": _OF_CAS,
}
# Keys that restart motion: C needs no Enter while the keyboard moves the robot.
RESTART_KEYS = "c\n"
_HEADER = ("", "ticks", "missed", "within 2 ms", "p50 ms", "p99 ms", "max ms")


def main(arguments: Sequence[str]) -> int:
    """Run the command, and return its exit status."""
    subcommand = f"robot.{arguments[0]}" if arguments else ""
    if subcommand in names("commands") or subcommand in not_installed("commands"):
        return _run_subcommand(subcommand, arguments[1:])
    options = parse(arguments)
    if options.env is not None:
        from vlagents_ray.cli.simulated_robot import drive

        return drive(options)
    try:
        with ended_by_signals(*END_SIGNALS):
            report = _run(options)
    except KeyboardInterrupt:
        print(error_line("interrupted"), file=sys.stderr)  # noqa: T201
        return 128 + signal.SIGINT
    except VLAgentsError as error:
        print(printable(error_line(f"{type(error).__name__}: {error}")), file=sys.stderr)  # noqa: T201
        return 2
    if report.mostly_safe is not None:
        return MOSTLY_SAFE
    return 1 if report.safe_ticks else 0


def _run_subcommand(name: str, arguments: Sequence[str]) -> int:
    """Run a subcommand of a plug-in, such as "robot.check", and return its exit status."""
    try:
        run: Callable[[Sequence[str]], int] = registered_function("commands", name)
    except VLAgentsError as error:
        print(printable(error_line(f"{type(error).__name__}: {error}")), file=sys.stderr)  # noqa: T201
        return 2
    with ended_by_signals(*END_SIGNALS):
        return run(arguments)


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments; the process ends with status 2 if they are inconsistent."""
    parser, robot_actions, env_actions = command_parser()
    options = parse_all(parser, arguments, _CURES)
    in_env = options.env is not None

    refused: list[str] = []
    for action in robot_actions if in_env else env_actions:
        if getattr(options, action.dest) != action.default:
            refused.append(action.option_strings[0])
    if refused:
        condition = "with" if in_env else "without"
        parser.error(
            f"expected no {', '.join(refused)} {condition} --env, got some; leave them out"
        )

    if not in_env and options.policy is None:
        parser.error("expected a URL or --env, got neither; give one of them")
    if options.robot_set and options.robot is None:
        parser.error(
            "--robot-set: expected --robot with it, got none; name the robot with --robot "
            "NAME:ARGUMENT or MODULE:CLASS"
        )

    if options.mode is None:
        # A simulation stands still while it waits for its policy.
        options.mode = "open_loop" if in_env else "auto"
    if options.mode != "async" and (options.merge != "newest" or options.rtc):
        parser.error(
            f"--merge and --rtc: expected --mode async with them, got --mode {options.mode}"
        )
    return options


def _say(line: str) -> None:
    """Print a line at once."""
    print(printable(line), flush=True)  # noqa: T201


def _run(options: argparse.Namespace) -> LoopReport:
    """Connect to the policy, open the robot, run the control loop, and print the report."""
    say = _say
    hz = options.hz or _HZ
    report = LoopReport(hz)
    failure: BaseException | None = None

    # Raise errors for wrong names before any connection.
    make_robot = None
    if options.robot:
        make_robot = robot_factory("--robot", options.robot, options.robot_set)
    open_leader = leader_named("--teleop", options.teleop) if options.teleop else None

    with contextlib.ExitStack() as stack:
        commands = CommandInbox() if options.allow_remote_stop else None
        agent = RemoteAgent(  # the chunk player closes the agent
            options.policy,
            transport=options.transport,
            timeout_s=options.timeout_s,
            commands=commands,
        )
        agent.initialize()
        contract = agent.contract
        leader = None
        if open_leader is not None:
            leader = stack.enter_context(_opened_leader(open_leader, options, contract, say))

        guard = _guard(options, contract, hz)
        make_robot = make_robot or partial(SimulatedRobot, contract)
        robot = stack.enter_context(opened(make_robot))
        _require_measure(options.measure, contract, robot, say)
        fit, delay_s = _require_fit(options, agent, robot, guard.limits, say)

        choice = _choice(options, agent, hz, delay_s)
        say(choice.line)
        logger.info("%s", choice.line)
        settings = choice.settings
        player = stack.enter_context(ChunkPlayer(agent, settings, check=guard, override=leader))
        player.initialize()  # raises for unsuitable settings before the robot moves

        recorder = None
        if options.record:
            opened_recorder = Recorder(options.record, hz, interventions=leader is not None)
            recorder = stack.enter_context(opened_recorder)
            say(recorder.description)
        viewer = None
        if options.rerun is not None:
            viewer = stack.enter_context(open_viewer(options.rerun))

        hanging_s = max(0.2, 5 / hz) + (settings.deadline_s or 0.0)
        limits_s = {"server": options.silent_s, "loop": hanging_s}
        keys = _RunKeys(recorder, say)
        watchdog = stack.enter_context(_watched(robot, limits_s, keys, say))

        def is_over() -> bool:
            keys.say_restart()
            return keys.over

        loop_options = LoopOptions(
            restart=options.restart,
            commands=commands,
            fit=fit,
            viewer=viewer,
            real_time=options.real_time,
            report=report,
        )
        try:
            run_loop(
                robot,
                player,
                hz=hz,
                seconds=options.seconds,
                until=is_over,
                instruction=options.instruction,
                watchdog=watchdog,
                recorder=recorder,
                options=loop_options,
            )
        except BaseException as error:  # noqa: BLE001 - raised again after the report
            failure = error

        _say_report(report, f"{choice.mode}, {agent.transport}", say, led=leader is not None)

    if recorder is not None:  # the recorder is closed, so that all frames are written
        say(
            f"recorded: {recorder.episodes} episodes in {options.record}, {recorder.dropped} "
            "frames dropped"
        )
    if viewer is not None:
        say(viewer.report())
    if failure is not None:
        raise failure
    return report


@contextlib.contextmanager
def _watched(
    robot: Robot, limits_s: dict[str, float], keys: _RunKeys, say: Callable[[str], None]
) -> Iterator[Watchdog]:
    """Make the robot's watchdog, not yet started, which prints stops and the end of silences.
    Within the context, the operator can restart the robot and use the keys.
    """

    def stop(reason: str) -> None:
        """Stop the robot, and print the reason."""
        robot.stop()
        say(f"stopped by the watchdog: {reason}")

    def silence_ended(source: str) -> None:
        """Print that a source gives signs of life again, and how the robot continues."""
        say(_after_silence(source, watchdog.control, has_terminal=has_terminal))

    watchdog = robot_watchdog(robot, stop, limits_s, silence_ended)
    with _restarting(watchdog, say, keys.press, keys.restart_signal) as has_terminal:
        if has_terminal:
            say(KEYS)
        else:
            say(
                "no keys, as there is no terminal; SIGTERM ends the run, and SIGUSR1 restarts "
                "motion after a stop"
            )
        yield watchdog


@contextlib.contextmanager
def _opened_leader(
    open_leader: OpenLeader,
    options: argparse.Namespace,
    contract: Contract | None,
    say: Callable[[str], None],
) -> Iterator[Leader]:
    """Open the operator's device within the context, and print how to use it."""
    measure = measured_state(*options.measure)
    with open_leader(contract, step=options.step, measure=measure) as leader:
        help_text = getattr(leader, "help", "")
        if help_text:
            say(help_text)
        yield leader


def _guard(options: argparse.Namespace, contract: Contract | None, hz: float) -> Guard:
    """Return the guard of a policy with this contract, with the limits of the options."""
    return Guard(
        contract,
        max_step=options.max_step,
        measure=measured_state(*options.measure),
        limits=options.limits,
        hz=hz,
        soft_start_s=options.soft_start_s,
    )


def _choice(
    options: argparse.Namespace, agent: RemoteAgent, hz: float, delay_s: float | None
) -> Choice:
    """Return the mode and the settings of the chunk player for a policy, whose answers take
    `delay_s` as far as this is known.
    """
    contract = agent.contract
    safe = options.safe
    is_relative_known = contract is not None and contract.action.relative is not None
    if safe == "auto" and not options.robot and not is_relative_known:
        # The simulated robot uses actions without a declared type as absolute targets.
        safe = "hold"

    return choose_for(
        agent,
        mode=options.mode,
        hz=hz,
        delay_s=delay_s,
        execute=options.execute,
        merge=options.merge,
        horizon=options.horizon,
        safe=safe,
        max_age_s=options.max_age_s,
        deadline_s=None if options.deadline_ms is None else options.deadline_ms / 1e3,
        real_time_chunking=options.rtc,
    )


def _require_measure(
    names: Sequence[str], contract: Contract | None, robot: Robot, say: Callable[[str], None]
) -> None:
    """Check the parts of the state with the measured pose, before the robot moves. If there are
    none, say so, as the first action may then be anywhere.

    Args:
        names: The parts that --measure names, in the order of an action.
        contract: The policy's contract.
        robot: The robot.
        say: Prints a line.

    Raises:
        ConfigError: The robot's state lacks a part, or the parts have another number of values than
            an action.
    """
    state = robot.observe().state
    for name in names:
        if name not in state:
            raise ConfigError(
                f"--measure: expected parts of the robot's state, of {sorted(state)}, got "
                f"{name!r}{did_you_mean(name, state)}"
            )

    spec = contract.action if contract is not None else ActionSpec()
    if spec.dim is None:
        return
    columns = Columns.from_spec(spec, spec.dim, contract_of(robot).action)
    joint_count = spec.dim - len(columns.grippers)
    sizes = {name: len(values) for name, values in state.items()}
    measured = sum(sizes[name] for name in names)
    if names and measured not in (spec.dim, joint_count):
        without = f", or {joint_count} without grippers" if columns.grippers else ""
        raise ConfigError(
            f"--measure: expected parts with {spec.dim} numbers, as an action has{without}, got "
            f"{measured} in {', '.join(f'{name} ({sizes[name]})' for name in names)}; the robot's "
            f"state has {', '.join(f'{name} ({size})' for name, size in sizes.items())}"
        )

    has_targets = len(columns.absolute) > len(columns.grippers)
    if not names and has_targets and not getattr(robot, "simulated", False):
        found = _measurable_parts(sizes, spec.arms or (), (spec.dim, joint_count))
        cure = (
            f"give --measure {','.join(found)}"
            if found
            else (
                "add the pose to the robot's state, in the order of an action, and name it with "
                "--measure"
            )
        )
        say(
            "no measured pose: the first action is not compared with the pose of the robot, and "
            f"may be anywhere within the limits; {cure}"
        )


def _measurable_parts(
    sizes: Mapping[str, int], arms: Sequence[str], numbers: Collection[int]
) -> list[str]:
    """Return the parts of a state that contain the pose of an action: the joints of each arm, with
    or without its gripper; [] if there are no such parts.

    Args:
        sizes: The number of values of each part.
        arms: The names of several arms, in the order of an action; empty for one arm.
        numbers: The numbers of values that the parts may have together.
    """
    for of_arm in (("joints", "gripper"), ("joints",)):
        parts = [f"{arm}/{name}" for arm in arms for name in of_arm] if arms else [*of_arm]
        if all(part in sizes for part in parts) and sum(sizes[part] for part in parts) in numbers:
            return parts
    return []


def _require_fit(
    options: argparse.Namespace,
    agent: Agent,
    robot: Robot,
    limits: MotionLimits | None,
    say: Callable[[str], None],
) -> tuple[Fit, float | None]:
    """Compare the policy's first chunk with the training data of the checkpoint and the limits of
    the arm, and print all three. Measure the delay of an answer if the mode depends on it.

    Returns:
        The comparison, and the delay, s; None if it was not measured.

    Raises:
        ContractMismatch: They do not fit, and --ignore-mismatch is not given.
    """
    trained = None if options.stats is None else Trained.read(options.stats)
    fit = fit_of(agent, robot, limits, trained=trained, accept=options.ignore_mismatch)

    is_default = options.robot is None
    if fit.trained == Trained() and not is_default:
        message = (
            "the policy declares no ranges of its training data, so the arm's pose and the first "
            "chunk cannot be checked against them; give the ranges with --stats FILE"
        )
        say(message)
        logger.info("%s", message)

    compares = fit.compares and not (is_default and trained is None)
    delay_s = None
    if compares or options.mode == "auto":
        obs = robot.observe()
        agent.reset(obs, options.instruction)
        if options.mode == "auto":
            delay_s = measured_delay(agent, obs)
        if compares:
            rows = agent.act(obs).rows()
            for line in fit.draw(rows):
                say(line)
                logger.info("%s", line)
            fit.require(obs, rows)
    return fit, delay_s


def _say_report(report: LoopReport, name: str, say: Callable[[str], None], *, led: bool) -> None:
    """Print the report of a run, without the timing if the run ended before the first tick.

    Args:
        report: The report of the loop.
        name: The title of the row of numbers.
        say: Prints a line.
        led: Whether an operator could take over.
    """
    if report.outcome:
        say(f"marked as a {report.outcome}")
    if report.jitter:
        _say_table(report, name, say)
        _say_outcome(report, say, led=led)


def _say_table(report: LoopReport, name: str, say: Callable[[str], None]) -> None:
    """Print the table of the loop's jitter."""
    jitter = report.jitter
    numbers = [
        f"{jitter['ticks']:.0f}",
        f"{jitter['missed']:.0f}",
        f"{100 * jitter['on_time']:.2f} %",
    ]
    times = [f"{jitter[key]:.3f}" for key in ("p50_ms", "p99_ms", "max_ms")]
    for title, *cells in (_HEADER, (name, *numbers, *times)):
        say(f"{title:<20}" + "".join(f"{cell:>13}" for cell in cells))


def _say_outcome(report: LoopReport, say: Callable[[str], None], *, led: bool) -> None:
    """Print the delays, the ticks without an action of the policy, and the stops."""
    say(
        f"from a tick until its action is applied: p50 {report.work_p50_ms:.2f} ms, p99 "
        f"{report.work_p99_ms:.2f} ms"
    )
    if led:
        say(
            f"ticks at which an operator moved the robot: {report.interventions}; ticks paused: "
            f"{report.paused}"
        )
    say(
        f"ticks without an action of the policy: {report.safe_ticks} of "
        f"{report.jitter['ticks']:.0f}"
    )

    _say_timeliness(report, say)
    if report.careful:
        say(f"ticks of waiting by choice before a gripper moves (fresh_grip): {report.careful}")
    if report.slow is not None:
        say(report.slow)
    elif report.rows_per_tick is not None:
        say(f"rows of the plan per tick: {report.rows_per_tick:.2f}, full speed")

    causes = {**report.safe, "waiting": report.waiting}
    for cause, ticks in sorted(causes.items(), key=lambda item: -item[1]):
        if ticks:
            say(f"  {ticks} x {cause}, first: {report.reasons[cause]}")
    if report.mostly_safe is not None:  # `run_loop` has already logged the reason and the cure
        say(f"MOSTLY SAFE ACTIONS, exit status {MOSTLY_SAFE}")
    if report.blocking is not None:
        say(report.blocking)
    for bark in report.barks:
        say(f"stopped: {bark}")
    say(f"against jitter: {', '.join(report.means)}")


def _say_timeliness(report: LoopReport, say: Callable[[str], None]) -> None:
    """Print the share of ticks in time, and the ages of actions."""
    time_share = report.timeliness.time_share
    if time_share.ticks:
        say(in_words(time_share))


def _after_silence(source: str, control: RobotControl, *, has_terminal: bool) -> str:
    """Return a line for the operator about a source that gives signs of life again."""
    if control.silent:
        outcome = f"still no signal from the {' and the '.join(control.silent)}"
    elif not control.needs_restart:
        outcome = "the robot continues"
    elif has_terminal:
        outcome = "Enter or C restarts the robot"
    else:
        outcome = "SIGUSR1 restarts the robot"
    news = "the server answers" if source == "server" else f"signals from the {source}"
    return f"{news} again: {outcome}"


class _RunKeys:
    """Handles the operator's keys at the terminal during a run on a robot. A key that ends the run
    also stops the robot.
    """

    def __init__(self, recorder: Recorder | None, say: Callable[[str], None]) -> None:
        self.over = False  # whether the operator ended the run
        # What a signal to restart motion has done, until it is printed.
        self._restart_outcome: str | None = None
        self._recorder = recorder
        self._say = say

    def restart_signal(self, outcome: str) -> None:
        """Receive the outcome of a signal to restart motion; a signal handler must not print."""
        self._restart_outcome = outcome

    def say_restart(self) -> None:
        """Print the outcome of a signal to restart motion, if there was one."""
        outcome, self._restart_outcome = self._restart_outcome, None
        if outcome is not None:
            self._say(outcome)

    def press(self, key: str, control: RobotControl) -> bool:
        """Handle a key; return whether the key is known."""
        if key == "p" and control.reason is None:
            control.pause()
            self._say("paused; p continues")
        elif key == "p":
            control.resume()
            self._say("the policy continues")
        elif key in _LABELS:
            control.mark(_LABELS[key])
        elif key in ("x", "q"):
            if key == "x" and self._recorder is not None:
                self._recorder.label("discard")
            control.stop(f"{key} at the keyboard")
            self.over = True
        else:
            return False
        return True


@contextlib.contextmanager
def _restarting(
    watchdog: Watchdog,
    say: Callable[[str], None],
    press: Callable[[str, RobotControl], bool] = lambda *_: False,
    restart_signal: Callable[[str], None] = lambda _: None,
) -> Iterator[bool]:
    """Let the operator restart motion after a stop or a pause: with Enter or C at the terminal, or
    with SIGUSR1.

    Other keys are passed to `press`. The outcome of the signal, as text, is passed to
    `restart_signal` in the signal handler. Yields whether there is a terminal.
    """

    def restart() -> str:
        """Restart motion, unless a source of the watchdog is still silent; return the outcome, ""
        if the robot was not at rest.
        """
        control = watchdog.control
        was_standing = control.stopped or control.reason is not None
        if not watchdog.restart():
            return f"not restarted: still no signal from the {' and the '.join(control.silent)}"
        control.resume()
        return "restarted" if was_standing else ""

    def handle_key(key: str) -> bool:
        """Handle a key of the terminal; return whether the key is known."""
        if key not in RESTART_KEYS:
            return press(key, watchdog.control)
        outcome = restart()
        if outcome:
            say(outcome)
        return True

    def handle_signal(*_: object) -> None:
        outcome = restart()
        if outcome:
            restart_signal(outcome)

    with contextlib.ExitStack() as undo:
        has_terminal = undo.enter_context(typed_keys(handle_key))
        if threading.current_thread() is threading.main_thread() and hasattr(signal, "SIGUSR1"):
            before = signal.signal(signal.SIGUSR1, handle_signal)
            undo.callback(signal.signal, signal.SIGUSR1, before)
        yield has_terminal


def _panels_of_plugins() -> Iterator[HelpPanel]:
    """Yield the subcommands, robots and devices of plug-ins, including plug-ins that are not
    installed.
    """
    for title, group, prefix in (
        ("Subcommands", "commands", "robot."),
        ("Robots (--robot)", "robots", ""),
        ("Leaders (--teleop)", "leaders", ""),
    ):
        rows: list[HelpRow] = []
        for name, entry in entries(group).items():
            if name.startswith(prefix):
                suffix = entry.tasks if group == "robots" else ""
                rows.append(HelpRow(name.removeprefix(prefix) + suffix, entry.about))
        for name, distribution in not_installed(group).items():
            if name.startswith(prefix):
                cure = pip_install(distribution=distribution)
                rows.append(HelpRow(name.removeprefix(prefix), f"not installed: {cure}"))
        if rows:
            yield HelpPanel(title, tuple(rows))


class _RobotParser(CommandParser):
    """A parser whose help lists the names of plug-ins; they are read only for the help."""

    def help_page(self) -> HelpPage:
        """Return the help, with the names of plug-ins at its end."""
        page = super().help_page()
        return replace(page, panels=(*page.panels, *_panels_of_plugins()))


class _Options:
    """Adds the options of the command to one parser, in groups.

    Attributes:
        only_robot: The options that are rejected with --env.
        only_env: The options that need --env.
    """

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.only_robot: list[argparse.Action] = []
        self.only_env: list[argparse.Action] = []
        self._parser = parser
        self._group = parser.add_argument_group("Options")

    def begin(self, title: str, note: str = "") -> None:
        """Begin a group, to which the options added next belong.

        Args:
            title: The title of the group.
            note: A sentence about the group.
        """
        self._group = self._parser.add_argument_group(title, note)

    def both(self, *names: str, **settings: Any) -> None:
        """Add an option for a robot and for a simulation."""
        self._group.add_argument(*names, **settings)

    def robot(self, *names: str, **settings: Any) -> None:
        """Add an option for a robot."""
        self.only_robot.append(self._group.add_argument(*names, **settings))

    def env(self, *names: str, **settings: Any) -> None:
        """Add an option for a simulation."""
        self.only_env.append(self._group.add_argument(*names, **settings))


def command_parser() -> tuple[
    argparse.ArgumentParser, list[argparse.Action], list[argparse.Action]
]:
    """Return the parser of `vlagents-ray robot`.

    Returns:
        The parser, the options that are rejected with --env, and the options that need --env.
    """
    parser = _RobotParser("vlagents-ray robot", __doc__ or "", EXAMPLES["robot"])
    parser.add_argument(
        "policy",
        nargs="?",
        metavar="POLICY",
        help="URL of the policy's server. With --env, it may also be a registered policy, "
        "'module:Class', or be left out.",
    )
    options = _Options(parser)
    _add_robot_and_simulation(options)
    _add_chunk_options(options)
    _add_safety_options(options)
    _add_server_options(options)
    return parser, options.only_robot, options.only_env


def _add_robot_and_simulation(options: _Options) -> None:
    """Add the options of the robot, of the simulation, and of the operator."""
    seconds = number(above=True)
    settings: dict[str, Any] = {"action": "append", "metavar": "KEY=VALUE", "default": []}

    options.begin("Robot", "With --env, only --hz applies.")
    options.robot(
        "--robot",
        metavar="ROBOT",
        help="A name from the list below, or your MODULE:CLASS; default: a simulated robot.",
    )
    options.robot("--robot-set", **settings, help="An argument of the robot. May be repeated.")
    options.robot("--instruction", metavar="TEXT", help="The task in words.")
    options.robot(
        "--seconds", type=seconds, default=60.0, metavar="S", help="Length of the run in seconds."
    )
    options.both(
        "--hz",
        type=number(above=True, maximum=_MOST_HZ),
        metavar="HZ",
        help=f"Control rate in Hz; default: {_HZ:g}, or the rate of the environment.",
    )
    options.robot(
        "--real-time",
        action="store_true",
        help="Run the loop with SCHED_FIFO instead of a higher priority (nice).",
    )

    options.begin("Simulation")
    options.both(
        "--env",
        metavar="ENV",
        help="Drive this environment instead of a robot, such as tabletop or "
        "maniskill/PickCube-v1.",
    )
    options.env(
        "--env-set",
        **settings,
        help="An option of the environment, such as width=256. May be repeated.",
    )
    options.env("--set", **settings, help="A setting of the policy. May be repeated.")
    options.env(
        "--episodes",
        type=number(int, minimum=1),
        default=10,
        metavar="N",
        help="Number of episodes.",
    )
    options.env(
        "--seed",
        type=number(int),
        default=0,
        metavar="N",
        help="Seed of the first episode. Each further episode has the next number.",
    )

    options.begin("Operator and recording")
    options.both(
        "--teleop",
        metavar="LEADER",
        help="Device with which an operator takes over: a name from the list below, or your "
        "MODULE:CLASS.",
    )
    options.both(
        "--step",
        type=seconds,
        metavar="N",
        help="Increment of an action value per tick, for each pressed key or moved axis of the "
        "leader.",
    )
    options.robot(
        "--allow-remote-stop",
        action="store_true",
        help="Obey commands of the server's live page: pause, stop, success and failure. Not with "
        "--env.",
    )
    options.both(
        "--record",
        metavar="FOLDER",
        help="Record a LeRobotDataset v3.0 in this folder. Needs the extra 'record'.",
    )
    options.both(
        "--rerun",
        metavar="FOLDER",
        help="Write a .rrd file for Rerun into this folder; 'live' shows the run in Rerun's "
        "viewer.",
    )


def _add_chunk_options(options: _Options) -> None:
    """Add the options of the chunk player."""
    seconds = number(above=True)
    rows = number(int, minimum=1)

    options.begin("Action chunks", "With --env, only --mode and --execute apply.")
    options.both(
        "--mode",
        **one_of(*get_args(ChosenMode)),
        help="Mode that determines when the next chunk is requested and how chunks are executed, "
        "see docs/control_loop.md. auto chooses it from the policy's contract and its measured "
        "success; default: auto, with --env open_loop.",
    )
    options.both(
        "--execute",
        type=rows,
        metavar="N",
        help="Number of rows of a chunk that are executed before the next request.",
    )
    options.robot(
        "--horizon",
        type=rows,
        metavar="N",
        help="Largest number of rows of a chunk that may be executed.",
    )
    options.robot(
        "--merge",
        **one_of(*MERGES, ENSEMBLE),
        default="newest",
        help="How overlapping chunks are merged.",
    )
    options.robot(
        "--rtc",
        action="store_true",
        help="Real-time chunking: send the leftover plan and the expected delay with each request.",
    )
    options.robot(
        "--max-age-s",
        type=seconds,
        metavar="S",
        help="Largest age, in seconds, of the observation from which an executed action was "
        "computed.",
    )
    options.robot(
        "--deadline-ms",
        type=number(),
        metavar="MS",
        help="Time for which a tick waits for an action, in ms; default: 0 in mode async, "
        f"{WAIT_S * 1e3:.0f} in other modes.",
    )
    options.robot(
        "--safe",
        **one_of("auto", "hold", "zero"),
        default="auto",
        help="Action at a tick for which the policy has none.",
    )


def _add_safety_options(options: _Options) -> None:
    """Add the options of the guard and of the watchdog."""
    options.begin("Safety", "With --env, only --max-step, --limits and --soft-start-s apply.")
    options.both(
        "--max-step",
        type=number(),
        metavar="N",
        help="Largest change of an action value from one tick to the next.",
    )
    options.both(
        "--limits",
        metavar="PATH",
        help="File with limits of motion: .yaml, .json, .urdf, or the folder of a dataset, see "
        "docs/guard.md.",
    )
    options.both(
        "--soft-start-s",
        type=number(),
        default=SOFT_START_S,
        metavar="S",
        help="Time, in seconds of motion, over which the limits of --limits rise from half to "
        "full.",
    )
    options.robot(
        "--measure",
        type=_parts,
        default=(),
        metavar="PARTS",
        help="Parts of the state with the measured pose, in the order of an action, with or "
        "without grippers, such as joints, or left/joints,right/joints. The first action is "
        "compared with this pose.",
    )
    options.robot(
        "--stats",
        metavar="FILE",
        help="Statistics of the training, which the arm's pose and the first chunk must fit; "
        "default: the server's statistics, if it has any.",
    )
    options.robot(
        "--ignore-mismatch",
        action="store_true",
        help="Move even if the pose or the first chunk does not fit the statistics, and log the "
        "misfits.",
    )
    options.robot(
        "--silent-s",
        type=number(above=True),
        default=2.0,
        metavar="S",
        help="Stop the robot if the server is silent for this number of seconds.",
    )
    options.robot(
        "--restart",
        **one_of(*get_args(Restart)),
        help="How the robot restarts after a stop: with Enter, C or SIGUSR1 (manual), or when the "
        "server answers again (auto); default: manual, for a simulated robot auto.",
    )


def _parts(text: str) -> tuple[str, ...]:
    """Return the names of parts of the state that commas separate."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _add_server_options(options: _Options) -> None:
    """Add the options of the server."""
    seconds = number(above=True)

    options.begin("Server (not with --env)")
    options.robot(
        "--transport",
        **one_of("auto", "shm", "websocket", "http"),
        default="auto",
        help="Transport to the server.",
    )
    options.robot(
        "--timeout-s",
        type=seconds,
        default=10.0,
        metavar="S",
        help="Timeout of a request in seconds.",
    )
