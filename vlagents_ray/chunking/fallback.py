"""The safe action of a robot, which replaces late actions of the policy, and the checks of each
command.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

import numpy as np

from vlagents_ray.chunking.buffer import ChunkBuffer, Step
from vlagents_ray.chunking.ease import EaseIn
from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import (
    ConfigError,
    ConnectionLost,
    DeadlineExceeded,
    InvalidAction,
    PolicyFailed,
    PolicyUnavailable,
    VLAgentsError,
)
from vlagents_ray.interface import Obs
from vlagents_ray.validation import check_action

SafeName = Literal["auto", "hold", "zero"]
Cause = Literal[
    # The last answer has no rows left, and the next answer is pending. This is not counted as
    # `safe`.
    "waiting",
    # The next row moves a gripper because of an old observation, and the robot waits for a new
    # answer, as it was told to. This is not counted as `safe`.
    "careful",
    "late",  # the answer arrived after all its rows, or the leftover rows in its request, were due
    "old",  # the plan is older than max_age_s
    "stale",  # the observation is older than max_age_s
    "lost",  # the server did not answer: no connection, or not in time
    "failed",  # the policy raised an error
    "limits",  # the guard rejected the action: beyond a limit
    "max_step",  # the guard rejected the action: too far from the last action, or too fast
    "dynamics",  # the guard rejected the action: too much acceleration or jerk
    "invalid",  # the action is NaN, has a wrong shape, or was rejected by another check
    "leader",  # the operator's device returned no action
    "robot",  # the robot must not move (`holds`), for instance because a camera hangs
    "stopped",  # the robot was stopped and not restarted yet
    "paused",  # the robot is paused; such ticks are counted separately
    "other",  # an agent other than the chunk player gave a safe action
]


class Held(NamedTuple):
    """The reason why a robot holds still at a tick."""

    cause: Cause
    reason: str  # text with the numbers that matter


WAITING = Held("waiting", "waiting for an answer: all rows of the last one have been executed")
CAREFUL = Held(
    "careful",
    "the next row moves a gripper, but its observation is as old as fresh_grip: waiting for a new "
    "answer",
)
LATE = Held(
    "late",
    "the answer came so late that the robot had passed its rows; lower the latency, or the rate "
    "(hz)",
)
OLD = Held("old", "the planned action is older than max_age_s")
STALE = Held(
    "stale",
    "the observation is older than max_age_s, or of a clock that is ahead: look for a camera that "
    "hangs, for robot and sensors with different clocks, or for an info['captured_at'] that is not "
    "time.time()",
)
STOPPED = Held("waiting", "the robot was stopped since the observation that was answered last")
RELEASED = Held(
    "waiting", "the operator has released the robot, or a pause is over: waiting for a new answer"
)
_LOST = (ConnectionLost, PolicyUnavailable, DeadlineExceeded)


def refused(error: InvalidAction) -> Held:
    """Return why the robot holds still instead of executing a rejected action."""
    return Held(error.cause, str(error))


def unanswered(error: VLAgentsError) -> Held:
    """Return why the robot holds still after a request that ended with an error."""
    return Held("lost" if isinstance(error, _LOST) else "failed", f"{error.code}: {error}")


Safe = SafeName | np.ndarray | Callable[[Obs], np.ndarray]


class SafeAction:
    """Computes the action that holds a robot still, which depends on the meaning of each column.

    Targets keep the value of the last command, and motions are none. The name of the safe action
    confirms this meaning: "hold" is allowed if all columns are targets, "zero" if any column is a
    motion, and "auto" if the contract declares which. Before the first action, a single gripper
    keeps its measured opening. An array (D,), or a function of the observation that returns one
    (for instance of the measured joints), is used unchanged.

    Args:
        safe: The name, array or function of the safe action.
        spec: The actions of the contract.
        arm: The actions of the arm's contract, if it is known; see `Columns.from_spec`.

    Raises:
        ConfigError: The choice would be a guess or would move the robot: a repeated delta continues
            the motion, and zeros as joint targets move the arm to its zero position. Only "hold" is
            allowed if the contract does not describe the actions. The error is also raised if the
            contract contradicts itself.
    """

    def __init__(self, safe: Safe, spec: ActionSpec, arm: ActionSpec | None = None) -> None:
        self._spec, self._arm = spec, arm
        self._name = safe if isinstance(safe, str) else None
        self._make = safe if callable(safe) else None
        self._action = None
        if self._name is not None:
            _require_safe(self._name, spec, arm)
        elif self._make is None:
            self._action = np.asarray(safe, np.float32)
        if spec.dim is not None:
            self._columns(spec.dim)  # raises the errors of the contract

    def __call__(self, obs: Obs, last: np.ndarray | None) -> np.ndarray:
        """Return the safe action, (D,) float32.

        It may depend on the last command; raises `InvalidAction` if there is none.
        """
        if self._make is not None:
            return np.asarray(self._make(obs), np.float32)
        if self._action is not None:
            return self._action.copy()
        if last is not None:
            return self._columns(len(last)).still(last)

        first = None if self._spec.dim is None else self._first(obs, self._columns(self._spec.dim))
        if first is None:
            raise InvalidAction(
                f"safe: expected an action before it, got {self._name!r} before the first action; "
                "give an array or a function as the safe action"
            )
        return first

    def holds(self, last: np.ndarray) -> bool:
        """Return whether repeating the last command, (D,), keeps the robot in place."""
        columns = self._columns(len(last))
        return not columns.relative and (columns.is_known or self._name == "hold")

    def _columns(self, dim: int) -> Columns:
        return Columns.from_spec(self._spec, dim, self._arm)

    def _first(self, obs: Obs, columns: Columns) -> np.ndarray | None:
        """Return an action without motion that holds the gripper, (D,); None if the contract is
        not sufficient.
        """
        # An observation contains the opening of a single gripper, which is not sufficient for
        # several grippers.
        opening = None if len(columns.grippers) > 1 else obs.gripper
        return columns.first_still(opening)


def _require_safe(name: str, spec: ActionSpec, arm: ActionSpec | None) -> None:
    """Raise `ConfigError` if the safe action with this name would be a guess, or would move the
    robot.
    """
    if name not in get_args(SafeName):
        raise ConfigError(
            f"safe: expected one of {list(get_args(SafeName))}, an array or a function, "
            f"got {name!r}"
        )
    if spec.relative is None and name != "hold":
        raise ConfigError(
            "safe: expected a policy whose contract declares whether its actions are "
            f"relative or absolute, got safe={name!r} with one that does not; declare it "
            "(ActionSpec.delta), give safe='hold', which is right only for absolute "
            "actions, or give an action"
        )

    if spec.dim is None:
        has_motions = bool(spec.relative)
    else:
        has_motions = bool(Columns.from_spec(spec, spec.dim, arm).relative)
    expected = "zero" if has_motions else "hold"
    if name not in ("auto", expected) and spec.relative is not None:
        if name == "zero":
            consequence = "absolute actions would take as a pose to move to"
        else:
            consequence = "relative actions would continue to move with"
        raise ConfigError(
            f"safe: expected {expected!r} or 'auto', got {name!r}, which {consequence}; "
            "give one of them"
        )


Check = Callable[[np.ndarray, "np.ndarray | None"], np.ndarray]
"""Receives an action and the previous action, (D,) each, and returns the action to execute, or
raises `InvalidAction`.
"""


class Motion:
    """The motion of a robot in an episode: every action is checked against the previous action.

    Without a `check`, such as a `vlagents_ray.robot.Guard`, only the contract is checked. Without a
    `safe` action, an error is raised instead.
    """

    def __init__(
        self,
        check: Check | None,
        contract: Contract | None = None,
        safe: SafeAction | None = None,
        arm: ActionSpec | None = None,
    ) -> None:
        self._check, self._contract, self._safe = check, contract, safe
        self._spec = ActionSpec() if contract is None else contract.action
        self._arm = arm
        self.can_hold = safe is not None  # whether the action that keeps the robot still is known
        self._ease: EaseIn | None = None  # the ease-in, while a motion begins from rest
        self._last: np.ndarray | None = None  # the last commanded action
        self._before: np.ndarray | None = None  # last commanded action of earlier ticks
        self._is_corrected = False  # whether the last command was corrected; see `ChunkBuffer`
        self._state: Literal["stopped", "moving", "held"] = "stopped"

    @property
    def begun(self) -> bool:
        """Whether an action was commanded in this episode."""
        return self._last is not None

    @property
    def last(self) -> np.ndarray | None:
        """The last command of this episode, (D,) float32; None before the first one."""
        return None if self._last is None else self._last.copy()

    def keeps(self, plan: ChunkBuffer) -> bool:
        """Return whether the plan must not be replaced, since a robot that began at rest is
        approaching the next row.

        Another answer would begin at another pose, to which the command would jump.
        """
        if self._ease is None or self._ease.over:
            return False
        return not self._ease.arrived or (not self._ease.catches_up and plan.after is not None)

    def tick(self) -> None:
        """Begin a tick, at which one action may be commanded."""
        self._before = self._last

    def stop(self) -> None:
        """Record that the robot was stopped, and did not execute this tick's command."""
        self._last, self._ease = self._before, None
        self._state = "stopped"

    def move(self, action: np.ndarray, obs: Obs) -> np.ndarray:
        """Return the checked action of the policy or the operator, (D,) float32; raises
        `InvalidAction` if it must not be sent.
        """
        self._ease = None

        # First try to continue from the last target. The check may fail, since the robot may have
        # been moved, or may never have reached that target.
        if self._state == "held":
            with contextlib.suppress(InvalidAction):
                self._last, self._state = self._checked(action, self._last), "moving"
                return self._last

        last = self._last if self._state == "moving" else self._standing(obs, action)
        self._last, self._state = self._checked(action, last), "moving"
        return self._last

    def follow(self, plan: ChunkBuffer, obs: Obs) -> tuple[np.ndarray, int]:
        """Return the next command of a plan, (D,) float32, and the number of rows that it
        completes, and count it in the plan.

        If the robot is at rest, the check's `ease_in` first leads it onto the plan, whose rows wait
        meanwhile.

        Args:
            plan: The plan, which has a next row.
            obs: The current observation.

        Raises:
            InvalidAction: The command must not be sent.
            PolicyFailed: The plan has no next row.
        """
        self._settle(plan)
        step = plan.next
        if step is None:
            raise PolicyFailed(f"plan: expected a row for step {plan.executed}, got none")
        action = step.action

        ease_in = getattr(self._check, "ease_in", None)
        if self._state != "moving" and ease_in is not None:
            start = self._last if self._state == "held" else self._standing(obs, action)
            ease = ease_in(start, action, plan=plan.leftover())
            if ease is not None:
                self._ease, self._last, self._state = ease, start, "moving"

        ease = self._ease
        if ease is None or ease.over:
            command = self._execute(plan, step, obs)
            plan.advance(command)
            return command, 1

        last = self._last
        if last is None:  # The rows have only motions.
            last = Columns.from_spec(self._spec, len(action), self._arm).still(action)
        command, rows = ease.step(last, action, plan.after, plan.known)
        command = self._checked_part(step, command)
        self._last = command
        if ease.divides_rows:
            plan.ease(command, completes=bool(rows))
        else:
            plan.advance(command)
        self._settle(plan)
        return command, rows

    def _settle(self, plan: ChunkBuffer) -> None:
        """Settle the plan unless an ease-in divides its rows."""
        if self._ease is None or self._ease.over:
            plan.settle()

    def _execute(self, plan: ChunkBuffer, step: Step, obs: Obs) -> np.ndarray:
        """Return the command for the next step of a plan.

        A row that the check allows must not be rejected because it was corrected, as the plan would
        be dropped. The command is then corrected as far as the check allows.

        Raises:
            InvalidAction: The command must not be sent.
        """
        was_corrected, self._is_corrected = self._is_corrected, step.is_corrected
        if not was_corrected and not step.is_corrected:
            return self.move(step.action, obs)
        try:
            return self.move(step.action, obs)
        except InvalidAction:
            uncorrected = plan.uncorrected
            row = step.action if uncorrected is None else uncorrected.action
            nearest = getattr(self._check, "nearest", None)
            if nearest is None or self._state != "moving" or self._last is None:
                if not step.is_corrected:
                    raise
                return self.move(row, obs)

            allowed = nearest(step.action, self._last, row, brakes=was_corrected)
            if allowed is None:
                raise
            self._is_corrected = True
            return self.move(allowed, obs)

    def _checked_part(self, step: Step, command: np.ndarray) -> np.ndarray:
        """Return the checked command for a part of a step in an ease-in; see `_execute`."""
        was_corrected, self._is_corrected = self._is_corrected, step.is_corrected
        try:
            return self._checked(command, self._last)
        except InvalidAction:
            nearest = getattr(self._check, "nearest", None)
            if nearest is None or self._last is None or not (was_corrected or step.is_corrected):
                raise
            allowed = nearest(command, self._last, command, brakes=True)
            if allowed is None:
                raise
            self._is_corrected = True
            return self._checked(allowed, self._last)

    def hold(self, obs: Obs, why: Held) -> tuple[np.ndarray, Held]:
        """Return the action that keeps the robot still, (D,) float32, and the reason; raises
        `InvalidAction` if there is no such action.
        """
        if self._safe is None:
            raise InvalidAction(f"no action for this tick: {why.reason}")
        self._ease = None
        if self._last is None:  # The first command was rejected.
            self._state = "stopped"

        last = self._standing(obs) if self._state == "stopped" else self._last
        try:
            action = self._checked(self._safe(obs, last), last)
        except InvalidAction as refused:
            why = why._replace(
                reason=f"{why.reason}; the guard also rejects the safe action: {refused}"
            )
            if last is None or not self._safe.holds(last):
                raise InvalidAction(
                    f"no action for this tick: {why.reason}; change the guard's limits, or give "
                    "another safe action (safe=)"
                ) from refused
            action = self._checked(last, last)

        self._state = "held" if self._state == "moving" else self._state
        self._last = action
        return action.copy(), why

    def _standing(self, obs: Obs, action: np.ndarray | None = None) -> np.ndarray | None:
        """Return the position of a robot at rest, (D,), before a motion to `action`; None if the
        position is unknown.
        """
        reference = getattr(self._check, "reference", None)
        return self._last if reference is None else reference(obs, self._last, action)

    def _checked(self, action: np.ndarray, last: np.ndarray | None) -> np.ndarray:
        """Return an action, (D,) float32, that may be sent to the robot; raises `InvalidAction`
        for any other.
        """
        action = check_action(action, self._contract)
        if action.ndim != 1:
            raise InvalidAction(
                f"action: expected a single row (D,), got shape {action.shape}; pass one row of "
                "the chunk"
            )
        if self._check is not None:
            return self._check(action, last)
        if self._spec.rotation is not None:
            columns = Columns.from_spec(self._spec, len(action), self._arm)
            columns.require_rotations(action.tolist())
        return action
