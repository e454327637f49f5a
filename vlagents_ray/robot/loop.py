"""The control loop: observe, act, apply, at a fixed rate."""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import logging
import math
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, Protocol, TypeVar, get_args

import numpy as np

from vlagents_ray.abilities import (
    CountsTicks,
    HasCheck,
    HasControl,
    HasStatistics,
    Interruptible,
    ability,
)
from vlagents_ray.chunking.choice import choose_for
from vlagents_ray.chunking.control import RobotControl
from vlagents_ray.chunking.fallback import Cause, Held
from vlagents_ray.chunking.player import ChunkPlayer
from vlagents_ray.chunking.timeliness import Timeliness
from vlagents_ray.client.commands import CommandInbox
from vlagents_ray.contract import Contract, require_match
from vlagents_ray.errors import ConfigError, InvalidAction, VLAgentsError
from vlagents_ray.interface import (
    CAPTURED,
    CAUSE,
    IN_TIME,
    INTERVENTION,
    PLANNED,
    SAFE,
    SILENT,
    WANTED,
    Act,
    Agent,
    Obs,
)
from vlagents_ray.naming import did_you_mean
from vlagents_ray.registry import names, not_installed, registered_class
from vlagents_ray.robot.fit import Fit, Trained
from vlagents_ray.robot.guard import Guard
from vlagents_ray.robot.limits import MotionLimits
from vlagents_ray.robot.pacing import KEPT_TICKS, Pacer, jitter, undisturbed
from vlagents_ray.robot.record import Recorder
from vlagents_ray.robot.watchdog import Watchdog
from vlagents_ray.settings import require_arguments
from vlagents_ray.signals import END_SIGNALS, ended_by_signals, raise_dropped
from vlagents_ray.viewers import EpisodeViewer, LoopView

T = TypeVar("T")
Restart = Literal["manual", "auto"]
logger = logging.getLogger(__name__)

_COLLECT_S = 2.0
# The number of rows of the plan per tick below which a report names it: a run of a minute loses
# less at its beginning.
_FULL_SPEED = 0.98
ROBOT = ("observe", "apply", "stop")  # names of the methods of a `Robot`


class Robot(Protocol):
    """The interface of a robot that the control loop drives.

    A simulated robot may have the attribute `simulated = True`: it then restarts automatically
    after a stop (see `LoopOptions.restart`). A robot may have an attribute `holds`, the reason why
    it must not move now, such as a camera that hangs. While `holds` is not None, the loop keeps the
    robot stopped; then the loop continues with a new observation. A class around another robot
    derives from `vlagents_ray.robot.wrapper.RobotWrapper`, which keeps these attributes.

    `vlagents-ray robot` and the check of a robot use further attributes of a robot that has them:

    - `contract`: its observations and actions, with the columns of its grippers, which the policy's
      contract may not declare.
    - `joint_names`: its joints in the order of an action, with or without grippers. If each number
      of an action has a name, "gripper" in a name declares a gripper.
    - `joint_limits`: the range of each joint, (D, 2) in the joints' units.
    - `dates_pictures`: whether `captured_at` is derived from the time stamps of the sensors, which
      reveal a camera that hangs.
    - `operator`: of a simulated robot, an object that answers the questions of the check in place
      of the operator.
    - `clock`: of a simulated robot, a replacement of the module `time` with the simulated time.
    - `close`: called at the end. If the robot is a context manager, it is entered before its first
      use and exited at the end, and `close` is not called.
    """

    def observe(self) -> Obs:
        """Return the current sensor readings; must take only a fraction of a tick."""

    def apply(self, action: np.ndarray) -> None:
        """Command an action without waiting for the motion.

        Args:
            action: The action, (D,) float32, in the units of the policy's contract.
        """

    def stop(self) -> None:
        """Bring the robot to rest from any state; may be called repeatedly, and from another
        thread.
        """


def contract_of(robot: Robot) -> Contract:
    """Return the contract of a robot, with the names of its joints; an empty contract if the robot
    has none.
    """
    contract = getattr(robot, "contract", None) or Contract()
    joint_names = tuple(getattr(robot, "joint_names", ()))
    names = contract.action.names or joint_names or None
    return replace(contract, action=replace(contract.action, names=names))


def fit_of(
    agent: Agent,
    robot: Robot,
    limits: MotionLimits | None = None,
    *,
    trained: Trained | None = None,
    accept: bool = False,
) -> Fit:
    """Compare a policy's contract with a robot's contract, and return the object that compares
    their numbers before the first motion.

    Args:
        agent: The policy, after `initialize`.
        robot: The robot.
        limits: The limits of the robot.
        trained: The ranges of the policy's training data; default: the agent's `HasStatistics`. A
            simulated robot without a contract is not compared with them, since it executes numbers
            of any unit.
        accept: Whether numbers that do not fit are only logged as a warning.

    Returns:
        The comparison, whose `require` raises if numbers do not fit.

    Raises:
        ContractMismatch: The contracts differ.
    """
    require_match(agent.contract, contract_of(robot))

    if trained is None:
        is_simulated = getattr(robot, "simulated", False)
        has_units = not is_simulated or getattr(robot, "contract", None) is not None
        trained_on = ability(agent, HasStatistics)
        trained = Trained()
        if has_units and trained_on is not None:
            trained = Trained.from_statistics(trained_on.statistics or {})

    contract = agent.contract or Contract()
    state_names = list(contract.state or {})
    if contract.gripper:
        state_names.append("gripper")

    joint_names = tuple(getattr(robot, "joint_names", ()))
    return Fit(trained, limits, joint_names, tuple(state_names), accept)


def robot_watchdog(
    robot: Robot,
    stop: Callable[[str], None],
    silent_s: dict[str, float],
    silence_ended: Callable[[str], None] | None = None,
) -> Watchdog:
    """Return a watchdog that also watches the robot's own sources.

    Args:
        robot: The robot. Its attribute `silent_s`, if any, contains further sources and their
            longest silences, s. Its attribute `watchdog`, if any, is set to the watchdog, so that
            the robot can record signs of life of these sources.
        stop: Stops the robot; its argument is the reason (see `Watchdog`).
        silent_s: The longest silence of each source by name, s.
        silence_ended: Called with a source that gives signs of life again (see `Watchdog`).

    Returns:
        The watchdog, not yet started.
    """
    limits_s = {**getattr(robot, "silent_s", {}), **silent_s}
    watchdog = Watchdog(stop, limits_s, silence_ended)
    if hasattr(robot, "watchdog"):
        robot.watchdog = watchdog
    return watchdog


def import_class(option: str, name: str, methods: Sequence[str] = ()) -> Any:
    """Import a class that an option of the command line names.

    Args:
        option: The option for messages, such as "--robot".
        name: The class as "module:Class".
        methods: The methods that the class must have.

    Returns:
        The class.

    Raises:
        ConfigError: The class does not exist, its module cannot be imported, or it lacks a method.
    """
    module, colon, attribute = name.partition(":")
    if not colon:
        raise ConfigError(f"{option}: expected module:Class, as in my_arm:MyArm, got {name!r}")
    try:
        imported = importlib.import_module(module)
    except (ImportError, ValueError) as error:
        raise ConfigError(
            f"{option} {name}: {error}; go to the folder of its module (the present folder is "
            f"{os.getcwd()}), add the folder to PYTHONPATH, or install the module"
        ) from error
    except Exception as error:  # the module may raise any error, including a SyntaxError
        raise ConfigError(
            f"{option} {name}: {type(error).__name__}: {error}; correct the module {module!r}"
        ) from error

    cls = getattr(imported, attribute, None)
    if cls is None:
        public_names = [key for key in vars(imported) if not key.startswith("_")]
        hint = did_you_mean(attribute, public_names) or "; write the name of a class in this module"
        raise ConfigError(f"{option} {name}: module {module!r} has no {attribute!r}{hint}")
    return _with_methods(f"{option} {name}", cls, methods)


def _with_methods(where: str, cls: Any, methods: Sequence[str]) -> Any:
    """Return a class after checking that it has all methods.

    Raises:
        ConfigError: The class lacks a method.
    """
    missing = [method for method in methods if not callable(getattr(cls, method, None))]
    if missing:
        raise ConfigError(
            f"{where}: expected a class with {', '.join(methods)}, got a class without "
            f"{', '.join(missing)}; add these methods"
        )
    return cls


def robot_factory(option: str, name: str, settings: Iterable[str] = ()) -> Callable[..., Robot]:
    """Return a function that makes a robot.

    Args:
        option: The command-line option that names the robot, for messages.
        name: "module:Class", or a registered name and its argument, such as "mujoco:so101".
        settings: Further arguments of the robot as KEY=VALUE; a value that is not JSON is text.

    Returns:
        The function, which takes no arguments.

    Raises:
        ConfigError: The name is unknown, its class is not a robot class, or a setting is wrong.
    """
    arguments: dict[str, Any] = {}
    for text in settings:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(
                f"{option}-set: expected KEY=VALUE, as in port=/dev/ttyACM0, got {text!r}"
            )
        try:
            arguments[key] = json.loads(value)
        except json.JSONDecodeError:
            arguments[key] = value

    registered_name, _, argument = name.partition(":")
    make: Callable[..., Robot]
    if registered_name in names("robots") or registered_name in not_installed("robots"):
        cls = registered_class("robots", registered_name)
        make = partial(_with_methods(f"{option} {name}", cls, ROBOT), argument)
    else:
        make = import_class(option, name, ROBOT)

    require_arguments(f"{option} {name}", make, arguments)
    return partial(make, **arguments)


def _free_robots() -> None:
    """Free robots that nothing uses any longer, with all that they refer to.

    A renderer of a robot without `close` cannot be freed after its library has ended, and prints a
    traceback.
    """
    gc.collect()


@contextlib.contextmanager
def opened(make: Callable[[], Robot]) -> Iterator[Robot]:
    """Make a robot, yield it, and close it at the end.

    A robot that is a context manager is entered and exited; for any other robot, `close` is called
    if the robot has this method.

    Args:
        make: Makes the robot.

    Raises:
        ConfigError: The robot cannot be made.
    """
    try:
        robot = make()
    except VLAgentsError:
        raise
    except Exception as error:
        logger.info("robot: could not be made", exc_info=True)
        raise ConfigError(
            f"robot: could not be made: {type(error).__name__}: {error}; check its arguments "
            "(--robot-set), its cables and its power, or correct its class"
        ) from error

    with contextlib.ExitStack() as stack:
        # It is registered after the exit functions of the robot's libraries, and so called before
        # them.
        stack.callback(atexit.register, _free_robots)
        stack.callback(atexit.unregister, _free_robots)
        if isinstance(robot, contextlib.AbstractContextManager):
            stack.enter_context(robot)
        else:
            stack.callback(getattr(robot, "close", lambda: None))
        yield robot


def _cure(cause: Cause) -> str:
    """Return a sentence with the cure for ticks without an action of the policy."""
    match cause:
        case "waiting" | "late" | "old":
            return (
                "If answers arrive too late, use a lower rate (hz) or a policy with longer chunks, "
                "or let a tick wait for its answer (deadline_s, --deadline-ms)"
            )
        case "lost" | "failed":
            return "Read the server's log"
        case "limits" | "max_step" | "dynamics":
            return (
                "Compare the robot's pose with the policy's actions (units, order of joints, "
                "distance to the first action), and the limits with the pose and the actions; see "
                "docs/guard.md"
            )
        case "stopped":
            return (
                "After a stop, a robot that is not simulated waits for its operator "
                "(watchdog.restart()); see docs/control_loop.md"
            )
        case _:
            return "See docs/control_loop.md for this cause"


@dataclass(slots=True)
class LoopReport:
    """The outcome of a run of the control loop: its timing, and the ticks without an action of
    the policy.
    """

    hz: float
    jitter: dict[str, float] = field(default_factory=dict)  # see `vlagents_ray.robot.pacing.jitter`
    work_p50_ms: float = 0.0  # time from the due time of a tick to its applied action
    work_p99_ms: float = 0.0
    apply_p50_ms: float = 0.0  # the time of `robot.apply` alone
    # The number of ticks with the safe action or without any action, by cause.
    safe: dict[Cause, int] = field(default_factory=dict)
    # Why the first tick of each cause had the safe action or none, in words.
    reasons: dict[Cause, str] = field(default_factory=dict)
    # The number of ticks at which the robot did not move because all rows were executed and the
    # next answer had not arrived.
    waiting: int = 0
    # The number of ticks at which the robot waited by choice for a new answer, before it moves a
    # gripper (see `PlayerSettings.fresh_grip`); `safe` does not count them.
    careful: int = 0
    barks: list[str] = field(default_factory=list)  # reasons of stops by the watchdog or a command
    interventions: int = 0  # ticks at which an operator moved the robot
    # The number of ticks at which the robot was paused (see `vlagents_ray.chunking.control`);
    # `safe` does not count them.
    paused: int = 0
    done: bool = False  # the policy considered its task finished
    means: list[str] = field(default_factory=list)  # the measures taken against jitter
    outcome: str = ""  # "success" or "failure", if the episode was marked on the live page
    # The rows of the plan per tick with a row: 1 at full speed, less while the robot begins slowly.
    # None for an agent without a plan.
    rows_per_tick: float | None = None
    timeliness: Timeliness = field(default_factory=Timeliness)

    @property
    def safe_ticks(self) -> int:
        """The number of ticks at which an action of the policy was missing: the sum of `waiting`
        and all counts in `safe`.
        """
        return self.waiting + sum(self.safe.values())

    @property
    def mostly_safe(self) -> str | None:
        """A warning with its cure if more than half of the ticks had no action of the policy;
        else None.
        """
        ticks = int(self.jitter.get("ticks", 0))
        if 2 * self.safe_ticks <= ticks:
            return None

        cause: Cause = "waiting"
        most_ticks = self.waiting
        for safe_cause, safe_ticks in self.safe.items():
            if safe_ticks > most_ticks:
                cause, most_ticks = safe_cause, safe_ticks
        return (
            f"the policy hardly drove the robot: {self.safe_ticks} of {ticks} ticks had no action "
            f"of the policy, most often for this reason: {self.reasons.get(cause, cause)}. "
            f"{_cure(cause)}"
        )

    @property
    def slow(self) -> str | None:
        """A sentence with its cure if the robot did not execute the plan at full speed; else
        None.
        """
        rows = self.rows_per_tick
        if rows is None or rows >= _FULL_SPEED:
            return None
        return (
            f"rows of the plan per tick: {rows:.2f} of 1, as the limits let the robot begin each "
            "motion slowly; use longer chunks, or wider limits of acceleration and jerk"
        )

    @property
    def blocking(self) -> str | None:
        """A warning with its cure if `robot.apply` takes more than half of a tick; else None."""
        tick_ms = 1e3 / self.hz
        if self.apply_p50_ms <= tick_ms / 2:
            return None
        return (
            f"apply takes {self.apply_p50_ms:.3g} ms of a tick of {tick_ms:.3g} ms: send the "
            "command and return, without waiting for the arm to arrive"
        )

    def log_warnings(self) -> None:
        """Log `mostly_safe` and `blocking`, if they apply."""
        for warning in (self.mostly_safe, self.blocking):
            if warning is not None:
                logger.warning("%s", warning)

    def count(self, hold: Held) -> None:
        """Count a tick without an action of the policy.

        Args:
            hold: The reason why the tick has no action of the policy.
        """
        self.reasons.setdefault(hold.cause, hold.reason)
        if hold.cause == "paused":
            self.paused += 1
        elif hold.cause == "careful":
            self.careful += 1
        elif hold.cause == "waiting":
            self.waiting += 1
        else:
            self.safe[hold.cause] = self.safe.get(hold.cause, 0) + 1


@dataclass(frozen=True, slots=True)
class LoopOptions:
    """Options of the control loop that most callers leave at their defaults.

    Args:
        guard: Checks every action; a rejected action ends the loop. The default is the agent's own
            `check`, if it has one; a chunk player replaces an action that its check rejects with a
            safe action. Otherwise the default is a guard with the bounds of the agent's contract.
        restart: With "manual", the robot stays at rest after a stop until `watchdog.restart()` is
            called. Only an operator who sees the robot may call it, and it has no effect while a
            source is silent. With "auto", motion restarts when the silence ends; only a stop by a
            command still needs the call. The default is "auto" for a simulated robot and "manual"
            for any other robot.
        commands: The commands of the live page, from `RemoteAgent(url, commands=...)`: pause, stop,
            mark.
        fit: The comparison of policy and robot, e.g. one that accepts misfits; default:
            `fit_of(agent, robot, limits)`.
        reset_options: Further arguments of `agent.reset`.
        viewer: Shows the run as one episode (see `vlagents_ray.viewers`).
        real_time: Run the thread with SCHED_FIFO (see `vlagents_ray.robot.pacing.undisturbed`).
        report: A new report, which the caller can read even if the loop ends with an exception; by
            default the loop makes a report.

    Raises:
        ConfigError: `restart` has a wrong value.
    """

    guard: Guard | None = None
    restart: Restart | None = None
    commands: CommandInbox | None = None
    fit: Fit | None = None
    reset_options: Mapping[str, Any] = field(default_factory=dict)
    viewer: EpisodeViewer | None = None
    real_time: bool = False
    report: LoopReport | None = None

    def __post_init__(self) -> None:
        if self.restart is not None and self.restart not in get_args(Restart):
            raise ConfigError(
                f"restart: expected one of {list(get_args(Restart))}, got {self.restart!r}"
            )


def run_loop(
    robot: Robot,
    agent: Agent,
    *,
    hz: float,
    seconds: float | None = None,
    until: Callable[[], bool] = lambda: False,
    instruction: str | None = None,
    watchdog: Watchdog | None = None,
    recorder: Recorder | None = None,
    options: LoopOptions | None = None,
) -> LoopReport:
    """Reset an agent and let it drive a robot at a fixed rate, until the agent is done or the time
    is over.

    If `Guard.limits` has a rest pose, the robot moves there slowly after a run that ended without a
    stop, a pause, a mark or an exception. (A mark may come from the network, and a command from the
    network must never start a motion.) A stop also ends this motion. `robot.stop()` is always
    called at the end, even after an exception.

    The schedule is absolute, so there is no drift; a tick whose time has passed before it could
    begin is skipped and counted as missed. If more than half of the ticks had no action of the
    policy, `LoopReport.mostly_safe` is logged as a warning.

    SIGTERM, SIGHUP and SIGUSR1 end the loop with `SystemExit`, as Ctrl-C ends it with
    `KeyboardInterrupt`, in the main thread of a program without handlers for them. In other threads
    they end the process at once, and `robot.stop()` is not called.

    Args:
        robot: The robot.
        agent: The policy. A `ChunkPlayer` turns chunks into rows. An agent whose contract declares
            chunks is executed by one in the mode that is chosen for it
            (`vlagents_ray.chunking.choice`), which is logged.
        hz: The control rate, Hz.
        seconds: The length of the run, s; None runs until the policy or `until` ends it.
        until: Ends the loop when it returns True; called before each tick, and after the last one.
            This is not a stop: the robot still moves to its rest pose. Use `Watchdog.trip` or
            `RobotControl.stop` for a stop.
        instruction: The task in words.
        watchdog: Runs during the loop. Each tick is a sign of life of "loop", and the agent's
            answers (`act.info["silent_s"]`) are signs of life of "server". After the watchdog has
            stopped the robot, the loop commands nothing until motion is restarted, in this run or a
            later run. A chunk player discards its plan at the stop (`ChunkPlayer.interrupt`), so
            that the first command after the restart is computed from new observations; a guard with
            `measure` compares this command with the measured pose.
        recorder: Records the run as one episode, even if the run ends with an exception. A player
            with `override` needs a recorder with `interventions=True`.
        options: The guard, the restart after a stop, commands of the live page, and other options.

    Returns:
        The timing of the loop, and the reasons of the ticks without an action of the policy.

    Raises:
        ConfigError: `hz` or `seconds` has a wrong value, the guard differs from the agent's own or
            has limits for another rate, or the recorder has no columns for interventions.
        ContractMismatch: The policy does not fit the robot; raised before the policy's first
            motion.
        InvalidAction: An action is a chunk, or the guard rejects an action.
    """
    options = options or LoopOptions()
    if _returns_chunks(agent):
        choice = choose_for(agent, hz=hz)
        logger.info("%s", choice.line)
        guard = options.guard or Guard(agent.contract)
        with ChunkPlayer(_Borrowed(agent), choice.settings, check=guard) as player:
            return run_loop(
                robot,
                player,
                hz=hz,
                seconds=seconds,
                until=until,
                instruction=instruction,
                watchdog=watchdog,
                recorder=recorder,
                options=replace(options, guard=None),
            )

    restart = options.restart
    if restart is None:
        restart = "auto" if getattr(robot, "simulated", False) else "manual"
    if seconds is not None and not seconds > 0:
        raise ConfigError(f"seconds: expected a number above 0, or None, got {seconds}")

    control = _shared_control(agent, watchdog, options.commands)
    if control.leader is not None and recorder is not None and not recorder.interventions:
        raise ConfigError(
            "recorder: expected a recorder with interventions for a player with override=, got a "
            "recorder without; make Recorder(…, interventions=True)"
        )

    report = options.report or LoopReport(hz)
    earlier_stops = len(control.stops)

    agent.initialize()
    guard = _guard_of(agent, options.guard, hz)
    fit = options.fit or fit_of(agent, robot, guard.limits)
    # The arm may know grippers that the policy's contract does not declare.
    arm = contract_of(robot).action
    guard.join(arm)
    if isinstance(agent, ChunkPlayer):
        agent.join(arm)
    has_control = ability(agent, HasControl)
    has_check = ability(agent, HasCheck)
    run = _Run(
        robot=robot,
        agent=agent,
        interruptible=ability(agent, Interruptible),
        control=control,
        agent_has_control=has_control is not None and has_control.control is control,
        guard=guard,
        agent_has_guard=has_check is not None and has_check.check is guard,
        watchdog=watchdog,
        recorder=recorder,
        commands=options.commands,
        view=LoopView(options.viewer),
        report=report,
        fit=fit,
    )

    def is_over() -> bool:
        raise_dropped()  # also ends a run that commands nothing
        return until()

    with contextlib.ExitStack() as stack:
        # SIGUSR1 restarts a robot of the command, and may be sent to any program that drives one.
        stack.enter_context(ended_by_signals(*END_SIGNALS, signal.SIGUSR1))
        control.begin(auto=restart == "auto")
        try:
            obs = _observed(robot)
            fit.require(obs, None)
            agent.reset(obs, instruction, **options.reset_options)
            counts_ticks = ability(agent, CountsTicks)
            if counts_ticks is not None:
                report.timeliness = counts_ticks.timeliness
                run.agent_counts_ticks = True

            if recorder is not None:
                stack.enter_context(recorder.episode(instruction or ""))
            stack.enter_context(run.view.episode(instruction or ""))
            report.means = stack.enter_context(undisturbed(real_time=options.real_time))
            if watchdog is not None:
                stack.enter_context(watchdog)

            pacer = Pacer(hz)
            run.drive(pacer, seconds, is_over)
            run.go_to_rest(pacer)

            if options.commands is not None:
                options.commands.apply(control)  # of the answer to the last request
            report.outcome = control.end()
            if report.outcome and recorder is not None and recorder.interventions:
                recorder.label("success" if report.outcome == "success" else "failure")
        finally:
            control.running = False
            report.barks = control.stops[earlier_stops:]
            robot.stop()  # before the watchdog and the recorder are closed
    report.log_warnings()
    return report


def _returns_chunks(agent: Agent) -> bool:
    """Initialize an agent; return whether it declares chunks and has no player for them."""
    if ability(agent, HasControl) is not None:
        return False
    agent.initialize()
    contract = agent.contract
    return contract is not None and contract.chunk is not None and contract.chunk > 1


class _Borrowed(Agent):
    """An agent of the caller, which is not closed with its player."""

    def __init__(self, agent: Agent) -> None:
        self._agent = agent

    @property
    def contract(self) -> Contract | None:
        return self._agent.contract

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        return self._agent.reset(obs, instruction, **kwargs)

    def act(self, obs: Obs) -> Act:
        return self._agent.act(obs)

    def forwarded(self, protocol: type[T]) -> T | None:
        """Return an ability of the agent."""
        return ability(self._agent, protocol)


def _shared_control(
    agent: Agent, watchdog: Watchdog | None, commands: CommandInbox | None
) -> RobotControl:
    """Return the `RobotControl` that agent, watchdog and commands share from now on: the agent's
    control, else the watchdog's, else the control of the commands.
    """
    has_control = ability(agent, HasControl)
    control: RobotControl | None = None if has_control is None else has_control.control
    if control is None and watchdog is not None:
        control = watchdog.control
    if control is None and commands is not None:
        control = commands.control
    if control is None:
        control = RobotControl()

    if watchdog is not None:
        watchdog.share(control)
    if commands is not None and commands.control is not control:
        control.adopt(commands.control)
        commands.control = control
    return control


def _guard_of(agent: Agent, guard: Guard | None, hz: float) -> Guard:
    """Return the guard of a run: the caller's guard, the agent's guard, or a new guard for the
    agent's contract.

    Raises:
        ConfigError: There are two guards, or the guard has limits for another rate.
    """
    has_check = ability(agent, HasCheck)
    agent_guard = None
    if has_check is not None and isinstance(has_check.check, Guard):
        agent_guard = has_check.check
    if guard is not None and agent_guard is not None and agent_guard is not guard:
        raise ConfigError(
            "guard: expected either `guard` or the agent's own check=, got both; leave out one of "
            "these"
        )

    guard = guard or agent_guard or Guard(agent.contract)
    if guard.hz not in (None, hz):
        raise ConfigError(
            f"guard: expected limits for {hz} Hz, the rate of the loop, got limits for {guard.hz} "
            "Hz"
        )
    return guard


@dataclass(slots=True)
class _Run:
    """One run of the control loop: the objects that each tick uses."""

    robot: Robot
    agent: Agent
    interruptible: Interruptible | None  # the agent, if it has planned actions that it can drop
    control: RobotControl
    agent_has_control: bool  # whether the agent's `act` updates the control
    guard: Guard
    agent_has_guard: bool  # whether the agent's `act` checks its action with the guard
    watchdog: Watchdog | None
    recorder: Recorder | None
    commands: CommandInbox | None
    view: LoopView
    report: LoopReport
    fit: Fit | None  # None after the policy's first action
    counts: bool = False  # whether the last tick needed an action of the policy
    agent_counts_ticks: bool = False  # whether `act` counts its tick in the report's timeliness
    # Whether the robot is at rest: before the first action, and from a stop until the next action.
    standing: bool = True
    last: np.ndarray | None = None  # the last action that was applied, (D,)
    apply_s: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT_TICKS))

    def drive(self, pacer: Pacer, seconds: float | None, until: Callable[[], bool]) -> None:
        """Run ticks until the policy, `until`, a mark or the time ends the run. The timing is
        always written to the report.
        """
        work_s: deque[float] = deque(maxlen=KEPT_TICKS)
        missed = pacer.missed
        collected_at = time.monotonic()
        end_tick = None if seconds is None else max(1, round(seconds / pacer.period_s))
        try:
            while not (until() or self.report.done):
                # Free the reference cycles of failed requests, as automatic garbage collection is
                # off.
                if time.monotonic() - collected_at > _COLLECT_S:
                    gc.collect()
                    collected_at = time.monotonic()

                tick = pacer.wait()
                if end_tick is not None and tick >= end_tick:
                    pacer.forget(end_tick)
                    self._count_missed(pacer.missed - missed)
                    break

                obs = _observed(self.robot)
                if not self.agent_has_control:
                    self.control.update()

                act = self.agent.act(obs)
                if act.action.ndim != 1:
                    raise InvalidAction(
                        f"action: expected one row, got shape {act.action.shape}; wrap the agent "
                        "in a ChunkPlayer"
                    )
                self.report.done = act.done
                self._count(act)
                self._count_missed(pacer.missed - missed)
                missed = pacer.missed

                # These ticks are recorded before this tick's sign of life, which may be late.
                hold = self._reason_to_hold(act)
                if self.control.over:
                    break
                self._give_signs_of_life(act)

                action = None
                if hold is None:
                    action, hold = self._apply_act(obs, act)
                if hold is not None:
                    self._keep_still(hold)
                    self.view.add(obs, act, None, tick, pacer.since_tick_s(), hold.reason)
                elif action is not None:
                    work_s.append(pacer.since_tick_s())
                    self._record(obs, act, action, tick)
                    self.view.add(obs, act, action, tick, work_s[-1])
        finally:
            if isinstance(self.agent, ChunkPlayer):
                self.report.rows_per_tick = self.agent.rows_per_tick
            self.report.jitter = jitter(pacer.late_s, pacer.missed, pacer.ticks)
            if work_s:
                self.report.apply_p50_ms = float(np.median(self.apply_s)) * 1e3
                self.report.work_p50_ms = float(np.median(work_s)) * 1e3
                self.report.work_p99_ms = float(np.quantile(work_s, 0.99)) * 1e3

    def _count(self, act: Act) -> None:
        """Count whether the tick had an action of the policy in time."""
        info: Mapping[str, Any] = act.info
        if not self.agent_has_control and self.control.state == "autonomous":
            # An agent without a plan computes its action within the tick.
            info = {IN_TIME: SAFE not in info, **info}
        if not self.agent_counts_ticks:
            self.report.timeliness.count(info)
        self.counts = IN_TIME in info

    def _count_missed(self, ticks: int) -> None:
        """Count ticks that passed before this one without a call of the agent."""
        if self.counts:
            self.report.timeliness.count_missed(ticks)

    def _give_signs_of_life(self, act: Act) -> None:
        """Report to the watchdog that the loop is alive, and the time since the server's last sign
        of life.
        """
        if self.watchdog is None:
            return
        self.watchdog.heard("loop")
        silent_s: Any = act.info.get(SILENT)
        is_known = isinstance(silent_s, int | float) and 0 <= silent_s < math.inf
        self.watchdog.heard("server", float(silent_s) if is_known else 0.0)

    def _record(self, obs: Obs, act: Act, action: np.ndarray, tick: int) -> None:
        """Count and record an action that was applied."""
        is_intervention = INTERVENTION in act.info and SAFE not in act.info
        self.report.interventions += is_intervention
        if self.recorder is not None:
            self.recorder.add(
                obs,
                action,
                tick=tick,
                safe=SAFE in act.info,
                intervention=is_intervention,
                policy_action=act.info.get(WANTED),
            )

    def go_to_rest(self, pacer: Pacer) -> None:
        """Move slowly to the guard's rest pose, unless the robot must hold or the episode was
        marked.
        """
        last = self.last
        if last is None or self.standing:
            return
        try:
            for command in self.guard.way_to_rest(last):
                pacer.wait()
                _observed(self.robot)  # `observe` may update the robot's `holds`
                self.control.update()
                hold = self._reason_to_hold(Act(last))
                if hold is not None or self.control.state == "human" or self.control.over:
                    break

                if self.watchdog is not None:
                    self.watchdog.heard("loop")
                    self.watchdog.heard("server")  # this motion does not need the server
                last = self.guard(command, last)
                if self._command(last) is not None:
                    break
        except InvalidAction as error:
            logger.warning("the robot stops on its way to the rest pose: %s", error)

    def _reason_to_hold(self, act: Act) -> Held | None:
        """Apply new commands; return the reason why the robot must hold at this tick, or None."""
        if self.commands is not None:
            self.commands.apply(self.control)

        hold = self.control.hold()
        robot_reason = getattr(self.robot, "holds", None)
        if hold is not None:
            return hold
        if robot_reason is not None:
            return Held("robot", str(robot_reason))

        # The player may have chosen a safe action because of a stop or a pause that has ended
        # since.
        safe = _safe(act)
        if safe is not None and safe.cause in ("stopped", "paused"):
            return safe
        return None

    def _keep_still(self, hold: Held) -> None:
        """Keep the robot at rest for this tick."""
        if not self.standing:
            # Stop the robot again, as the watchdog may have stopped it just before the last action.
            self.robot.stop()
        self.standing = True
        if self.interruptible is not None:
            self.interruptible.interrupt()
        self.report.count(hold)

    def _apply_act(self, obs: Obs, act: Act) -> tuple[np.ndarray | None, Held | None]:
        """Apply the action of an agent.

        Returns:
            The applied action, (D,), and None; or None and the reason why the robot was stopped
            meanwhile. Both are None if the action is a safe action and the robot is at rest; the
            action is then not applied.
        """
        safe = _safe(act)
        action = act.action
        if safe is not None and self.standing:
            self.report.count(safe)
            return None, None

        is_of_policy = safe is None and not act.info.get(INTERVENTION)
        if self.fit is not None and is_of_policy:
            self.fit.require(None, act.info.get(PLANNED, action[np.newaxis]))
            self.fit = None

        if not self.agent_has_guard:
            last = self.last
            if self.standing:
                last = self.guard.reference(obs, self.last, action)
            action = self.guard(action, last)

        hold = self._command(action)
        if hold is not None:
            return None, hold
        if safe is not None:
            self.report.count(safe)
        return action, None

    def _command(self, action: np.ndarray) -> Held | None:
        """Apply an action, unless the robot has been stopped since this tick's check; return the
        reason if the action was not applied.

        After a signal that ends the program, no action is applied.
        """
        with self.control.command() as hold:
            if hold is not None:
                return hold
            raise_dropped()
            self.standing = False
            self.last = action

            began_s = time.perf_counter()
            self.robot.apply(action)
            self.apply_s.append(time.perf_counter() - began_s)

        if self.control.held is not None:  # the action may have been applied after the stop
            self.robot.stop()
        return None


def _safe(act: Act) -> Held | None:
    """Return the reason why an agent's action is the safe action; None if the action is the
    policy's or an operator's.
    """
    if SAFE not in act.info:
        return None
    return Held(act.info.get(CAUSE, "other"), str(act.info[SAFE]))


def _observed(robot: Robot) -> Obs:
    """Return the robot's observation with its capture time."""
    begun_at = time.time()
    obs = robot.observe()
    return obs if CAPTURED in obs.info else replace(obs, info={CAPTURED: begun_at, **obs.info})
