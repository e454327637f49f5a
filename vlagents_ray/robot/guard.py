"""The guard: the check of every action before it reaches a robot."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from vlagents_ray.chunking.ease import EaseIn
from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidAction, MissingState
from vlagents_ray.interface import Obs
from vlagents_ray.robot.limits import MotionLimits

SOFT_START_S = 120.0
# Twice the relative rounding error of a float32, since actions may be computed from larger ones of
# earlier ticks.
_ROUNDING = 2.0**-23
# The first action may be as far away as the arm moves in this time at its velocity limit, s.
_FIRST_S = 0.5
# The motion from rest to the first action takes this many times longer than its limits require.
_SLOWNESS = 2.0
_BISECTIONS = 16  # halvings of a way: a share is exact to 2e-5


class Guard:
    """A check that accepts an action or raises `InvalidAction`; it never clips an action, since a
    clipped action is a different motion.

    The guard checks the action's shape, that its numbers are finite and within the bounds, and that
    it is not too far from the previous action. The first action has no previous action, and after a
    stop the arm may not be where the last action commanded it. With `measure`, the first action and
    an action after a stop are compared with the measured pose, and their grippers with the last
    command. Without `measure`, the first absolute action may be anywhere within the bounds, and an
    action after a stop is compared with the last action. Motions are compared with no motion, even
    after a stop. The difference of a rotation is its angle, rad, in any representation; the
    strictest limit of the rotation's numbers applies to it.

    With `limits`, speed, acceleration, jerk and the position of the tip are also checked. Braking
    is always allowed, as the robot's own stop is more abrupt. A chunk player then begins each
    motion from rest with an ease-in (`vlagents_ray.chunking.ease`), since the arm cannot reach the
    full speed of a plan in one tick.

    Args:
        contract: The policy's contract, for the action's dimension and bounds; None checks neither.
        low: Lower bound, for all numbers of an action or (D,), in the action's units; the strictest
            of this bound, the contract's bound and the bound in `limits` applies. Bounds of
            relative actions limit the actions themselves.
        high: Upper bound, in the same form as `low`.
        max_step: Largest difference between two consecutive actions, for all numbers or (D,); None
            checks none.
        measure: Returns the measured pose in an observation, (D,) in the action's order and units,
            e.g. `lambda obs: obs.state["joints"]`; not for actions whose numbers are all motions.
        limits: The limits of the robot's motion, or the path that `MotionLimits.read` reads.
        hz: The control rate, Hz; needed with `limits`.
        soft_start_s: The time of motion, s, during which the limits of speed, acceleration and jerk
            rise from half of their values to the full values, since most accidents happen in the
            first minutes of a new checkpoint; 0 disables the soft start.

    Raises:
        ConfigError: A bound is NaN or has another number of values than an action, `max_step` is
            negative, `measure` is given for relative actions, `limits` is given without `hz`, a
            limit has no effect on the actions of the contract, or the contract contradicts itself.
    """

    def __init__(
        self,
        contract: Contract | None = None,
        *,
        low: float | np.ndarray | None = None,
        high: float | np.ndarray | None = None,
        max_step: float | np.ndarray | None = None,
        measure: Callable[[Obs], np.ndarray] | None = None,
        limits: MotionLimits | str | Path | None = None,
        hz: float | None = None,
        soft_start_s: float = SOFT_START_S,
    ) -> None:
        spec = contract.action if contract is not None else ActionSpec()
        if isinstance(limits, (str, Path)):
            limits = MotionLimits.read(limits, spec)
        self.limits = limits
        self.hz = hz
        self._spec = spec
        self._dim = spec.dim
        self._joint_unit = _joint_unit(contract)

        bounds = limits or MotionLimits()
        self._low = _strictest("low", np.maximum, spec, spec.low, low, bounds.low)
        self._high = _strictest("high", np.minimum, spec, spec.high, high, bounds.high)
        self._max_step = None if max_step is None else np.asarray(max_step, np.float64)

        # This also rejects NaN, which would accept any step.
        if self._max_step is not None and not (self._max_step >= 0).all():
            raise ConfigError(f"max_step: expected a number of 0 or more, or None, got {max_step}")
        if limits is not None and (hz is None or not hz > 0 or not soft_start_s >= 0):
            raise ConfigError(
                "limits: expected a control rate above 0 Hz, and a soft start of 0 s or more, "
                f"got hz={hz}, soft_start_s={soft_start_s}"
            )

        if measure is not None and spec.dim is None and spec.relative and not spec.absolute:
            raise _not_measurable()
        self._measure = measure
        self._soft_ticks = soft_start_s * (hz or 0.0)
        self._ticks_with_motion = 0

        self._arm: ActionSpec | None = None  # the actions of the arm's contract
        self._columns: Columns | None = None  # the meaning of the numbers of an action
        # The limits low, high, max_step, velocity, acceleration and jerk, each with a value for
        # each number of an action, in the action's units and in ticks.
        self._limits: list[list[float]] = []
        # Columns of rotations, whose differences are vectors, and all other columns.
        self._turns: list[tuple[int, ...]] = []
        self._numbers: list[int] = []

        self._accepted: list[float] | None = None  # the last accepted action; None at rest
        # speeds: differences between the last accepted action and the action before, units per
        # tick.
        self._speeds: list[float] = []
        self._changes: list[float] = []  # differences between these speeds and the speeds before
        if self._dim is not None:
            self._limits_of(self._dim)

    @property
    def bounds(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """The lower and the upper bound of an action, also those of the contract: a number, or
        (D,); None for no bound.
        """
        return self._low, self._high

    def join(self, arm: ActionSpec) -> None:
        """Join the arm's description of its columns to the policy's.

        The arm may know grippers that the policy's contract does not declare.

        Args:
            arm: The actions of the robot's contract.

        Raises:
            ConfigError: The descriptions contradict each other or the limits.
        """
        self._arm = arm
        dim = self._dim if self._columns is None else self._columns.dim
        self._columns = None
        if dim is not None:
            self._limits_of(dim)

    def reference(
        self, obs: Obs, last: np.ndarray | None, action: np.ndarray | None = None
    ) -> np.ndarray | None:
        """Return the pose with which the first action, or the first action after a stop, is
        compared.

        The measured opening of a gripper is not its goal: a gripper that holds an object would let
        go if it were commanded to stay as it is measured. Its goal is the last command; before the
        first command, the goal is unknown, and the pose has the value of the action.

        Args:
            obs: The current observation.
            last: The last commanded action, (D,); None before the first action.
            action: The action at which the motion ends, (D,), if it is known.

        Returns:
            The measured pose, (D,) float32; `last` if the guard has no `measure`. None if no
            gripper was measured, and no goal of a gripper is known.

        Raises:
            ConfigError: `measure` returns another number of values than an action has.
            InvalidAction: `measure` returns NaN or infinity, so that no action can be checked.
        """
        self._accepted = None
        if self._measure is None:
            return None if last is None else self._columns_of(len(last)).still(last)

        goal = action if last is None else last
        measured = np.array(self._measure(obs), np.float32)
        dim = self._dim if goal is None else len(goal)
        columns = self._columns_of(measured.size if dim is None else dim)
        grippers = list(columns.grippers)
        if measured.ndim != 1 or len(measured) not in (columns.dim, columns.dim - len(grippers)):
            others = f", or {columns.dim - len(grippers)} without grippers" if grippers else ""
            raise ConfigError(
                f"measure: expected the shape of an action, ({dim or 'D'},), got {measured.shape}; "
                f"return one number for each number of an action{others}"
            )
        if not np.isfinite(measured).all():
            raise InvalidAction(
                f"measure: expected finite numbers, got {measured.tolist()}; the robot's sensors "
                "are broken"
            )

        pose = measured
        if len(measured) < columns.dim:
            if goal is None:
                return None
            pose = np.array(goal, np.float32)
            pose[[i for i in range(columns.dim) if i not in grippers]] = measured
        if goal is not None:
            pose[grippers] = goal[grippers]
        return columns.still(pose)

    def __call__(self, action: np.ndarray, last: np.ndarray | None = None) -> np.ndarray:
        """Return an action if the robot may execute it.

        Args:
            action: The action, (D,) float32.
            last: The action or pose from which the motion begins, (D,); None skips the checks of
                steps and speeds.

        Returns:
            The action, unchanged.

        Raises:
            InvalidAction: The action has a wrong shape, is not finite, exceeds a bound, or is too
                far from `last`.
        """
        action = np.asarray(action)
        if action.ndim != 1 or action.dtype.kind != "f" or self._dim not in (None, len(action)):
            dim = "D" if self._dim is None else self._dim
            raise InvalidAction(
                f"action: expected ({dim},) float32, a single row, got {action.shape} "
                f"{action.dtype}"
            )
        numbers = action.tolist()  # plain floats: for so few numbers they are faster than numpy
        if not all(map(math.isfinite, numbers)):
            raise InvalidAction(
                f"action: expected finite numbers, got {numbers}; check the policy's output"
            )

        low, high, *_ = self._limits_of(len(numbers))
        columns = self._columns_of(len(numbers))
        columns.require_rotations(numbers)
        for i, number in enumerate(numbers):
            if not low[i] <= number <= high[i]:
                name, limit = ("below", low[i]) if number < low[i] else ("above", high[i])
                raise InvalidAction(
                    f"action[{i}]: expected a number within the limits, got {number:g}, {name} "
                    f"the limit {limit:g}; see the contract",
                    cause="limits",
                )
        if self.limits is not None and self.limits.chain is not None:
            self._check_workspace(self.limits, self.limits.chain.tip(numbers))

        if last is not None and last.shape != action.shape:
            raise InvalidAction(
                f"action: expected the shape {np.shape(last)}, as before, got {action.shape}"
            )
        if last is None:  # the arm is at rest in an unknown pose
            self._accepted = None
            last_numbers = columns.still(action).tolist()
        else:
            last_numbers = last.tolist()

        self._check_steps(columns, numbers, last_numbers)
        if self.limits is not None:
            self._record(numbers, *self._check_dynamics(columns, numbers, last_numbers))
        return action

    def _largest_share(self, last: np.ndarray, goal: np.ndarray, before: np.ndarray) -> float:
        """Return the largest share of the way from the last command to a row that the limits of
        steps and speeds allow at this tick.

        Args:
            last: The last command, (D,).
            goal: The row, (D,).
            before: The row before, (D,).

        Returns:
            The share, in [0, 1].

        Raises:
            InvalidAction: The plan itself is faster than the limits.
        """
        columns = self._columns_of(len(goal))
        goal_numbers, last_numbers = goal.tolist(), last.tolist()
        velocity_limits = self._limits_of(len(goal))[3]
        # A plan continues at the row before, or begins again at the last command.
        speeds = [columns.motion(goal_numbers, begin) for begin in (before.tolist(), last_numbers)]
        for (i, speed), (_, other_speed) in zip(*map(self._sizes, speeds), strict=True):
            limit = self._softness() * velocity_limits[i]
            if min(speed, other_speed) > limit + 2 * _ROUNDING * abs(goal_numbers[i]):
                raise self._refusal("velocity", i, speed, limit, 1)

        if self._may_follow(columns, goal_numbers, last_numbers):
            return 1.0

        # No motion is braking, which is always allowed.
        def may_travel(share: float) -> bool:
            command = columns.travel(last, goal, 0.0, share)
            return self._may_follow(columns, command.tolist(), last_numbers)

        return _largest(may_travel)

    def nearest(
        self, goal: np.ndarray, last: np.ndarray, row: np.ndarray, *, brakes: bool
    ) -> np.ndarray | None:
        """Return the action nearest to a corrected row of a plan that the guard allows.

        Args:
            goal: The corrected row, (D,).
            last: The last command, (D,).
            row: The row without the correction, (D,), at which the search begins.
            brakes: Whether the search begins at a stop if the guard rejects the row, since the last
                command was corrected. A row that is beyond the bounds, or too fast, remains
                rejected, and so does a row whose targets are.

        Returns:
            The action, (D,) float32; None if there is none.
        """
        columns = self._columns_of(len(goal))
        last_numbers = last.tolist()
        low, high, _, velocity, *_ = self._limits_of(len(goal))

        def is_allowed(action: np.ndarray) -> bool:
            numbers = action.tolist()
            within = all(low[i] <= number <= high[i] for i, number in enumerate(numbers))
            return within and self._may_follow(columns, numbers, last_numbers)

        def corrected(share: float) -> np.ndarray:
            action = columns.mean([row, goal], [1.0 - share, share])
            targets = list(columns.absolute)
            action[targets] = row[targets]
            return action

        if is_allowed(row):
            return corrected(_largest(lambda share: is_allowed(corrected(share))))

        speeds = self._sizes(columns.motion(row.tolist(), last_numbers))
        is_fast = any(
            speed > self._softness() * velocity[i] + 2 * _ROUNDING * abs(float(row[i]))
            for i, speed in speeds
        )
        is_within = all(low[i] <= number <= high[i] for i, number in enumerate(row.tolist()))
        if not brakes or is_fast or not is_within:
            return None

        # Targets have no correction. If they lagged behind, the next rows would be rejected too.
        def braked(share: float) -> np.ndarray:
            action = columns.travel(last, goal, 0.0, share)
            targets = list(columns.absolute)
            action[targets] = row[targets]
            return action

        if not is_allowed(braked(0.0)):
            return None
        return braked(_largest(lambda share: is_allowed(braked(share))))

    def _may_follow(
        self, columns: Columns, numbers: list[float], last_numbers: list[float]
    ) -> bool:
        """Return whether the limits of steps and speeds allow an action after another."""
        try:
            self._check_steps(columns, numbers, last_numbers)
            self._check_dynamics(columns, numbers, last_numbers)
        except InvalidAction:
            return False
        return True

    def ease_in(
        self,
        start: np.ndarray | None,
        goal: np.ndarray,
        *,
        plan: np.ndarray | None = None,
        far: bool = False,
    ) -> EaseIn | None:
        """Plan the ease-in from a pose at rest to an action.

        Args:
            start: The pose at rest, (D,) in the action's units; None if it is unknown. For relative
                actions, only the grippers are used.
            goal: The first action, (D,).
            plan: The rows of the plan that begins with `goal`, (H, D); its speeds are used for
                numbers without a limit of velocity.
            far: Whether the first action may be at any distance.

        Returns:
            The ease-in; None if there are no limits of speed, acceleration and jerk, or if the pose
            is unknown.

        Raises:
            InvalidAction: The action is farther from the pose than `MotionLimits.first`.
        """
        if self.limits is None:
            return None
        columns = self._columns_of(len(goal))
        if start is None:
            if len(columns.absolute) > len(columns.grippers):
                return None
            start = goal  # all numbers are motions, and the positions of the grippers are unknown
        if start.shape != goal.shape:
            return None

        distances = columns.step(columns.still(goal).tolist(), columns.still(start).tolist())
        if not far:
            self._check_first(self.limits, columns, start, goal, distances)
        dynamic_limits = (self.limits.velocity, self.limits.acceleration, self.limits.jerk)
        if all(limit is None for limit in dynamic_limits):
            return None

        *_, velocity, acceleration, jerk = self._limits_of(len(goal))
        at_once = self._at_once(columns)
        plan_speeds = self._plan_speeds(columns, goal if plan is None else plan)
        share = self._softness()
        ramp_ticks = 0.0
        approach_ticks = 0.0
        for i in range(len(goal)):
            if i in at_once:
                continue
            max_speed = share * velocity[i]
            max_acceleration = share * acceleration[i]
            max_jerk = share * jerk[i]

            # The other half of the acceleration and jerk remains for the policy's own motion.
            speed = max_speed if max_speed < math.inf else 2 * plan_speeds[i]
            ramp_ticks = max(ramp_ticks, 2 * speed / max_acceleration, 2 * speed / max_jerk)

            # The peaks of the quintic over T ticks: 1.875 D / T, 5.7735 D / T^2, 60 D / T^3.
            distance = abs(distances[i])
            fastest_ticks = max(
                1.875 * distance / max_speed,
                math.sqrt(5.7735 * distance / max_acceleration),
                (60 * distance / max_jerk) ** (1 / 3),
            )
            approach_ticks = max(approach_ticks, _SLOWNESS * fastest_ticks)

        ticks = math.ceil(approach_ticks)
        if not columns.relative:
            ticks = max(1, ticks)
        even_ramp_ticks = 2 * math.ceil(ramp_ticks / 2)
        return EaseIn(columns, start, ticks, even_ramp_ticks, self._largest_share, at_once=at_once)

    def _at_once(self, columns: Columns) -> list[int]:
        """Return the columns of grippers without limits, which jump to their position."""
        *_, velocity, acceleration, jerk = self._limits_of(columns.dim)
        at_once = []
        for i in columns.grippers:
            if velocity[i] == acceleration[i] == jerk[i] == math.inf:
                at_once.append(i)
        return at_once

    def _check_first(
        self,
        limits: MotionLimits,
        columns: Columns,
        start: np.ndarray,
        goal: np.ndarray,
        distances: Sequence[float],
    ) -> None:
        """Raise `InvalidAction` if the first action is too far from the pose at rest."""
        dim, hz = len(goal), self.hz or 0.0
        if limits.first is None:
            velocity = self._limits_of(dim)[3]
            allowed = [limit * hz * _FIRST_S for limit in velocity]
        else:
            allowed = self._per_number("first", limits.first, dim)

        # Motions begin anywhere, and so do the grippers beside them.
        anywhere = {*columns.relative, *columns.grippers} if columns.relative else set()
        begins, ends = start.tolist(), goal.tolist()
        for i, distance in self._sizes(distances):
            rounding = 2 * _ROUNDING * max(abs(begins[i]), abs(ends[i]))
            if i not in anywhere and distance > allowed[i] + rounding:
                raise InvalidAction(
                    f"action[{i}]: expected a first action at most {allowed[i]:.3g} from the pose "
                    f"{begins[i]:g}, got {ends[i]:g}, {distance:g} away; check that the policy is "
                    "for this arm, and the order and units of the joints; if all are right, raise "
                    "`first`",
                    cause="max_step",
                )

    def _plan_speeds(self, columns: Columns, plan: np.ndarray) -> list[float]:
        """Return the largest speed of each number in the rows of a plan, D units per tick."""
        rows = np.atleast_2d(plan).tolist()
        if columns.rotations:
            motions = [
                columns.motion(row, last) for last, row in itertools.pairwise(rows[:1] + rows)
            ]
            return np.abs(motions).max(0).tolist()  # type: ignore[no-any-return]
        numbers = np.asarray(rows)
        speeds: np.ndarray = np.abs(np.diff(numbers, axis=0)).max(0, initial=0.0)
        relative = list(columns.relative)
        speeds[relative] = np.abs(numbers[:, relative]).max(0)
        return speeds.tolist()  # type: ignore[no-any-return]

    def way_to_rest(self, last: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the commands of a slow motion to the rest pose; yield none if `limits` has no rest
        pose.

        Args:
            last: The last command, (D,) float32.

        Yields:
            The commands, (D,) float32.
        """
        if self.limits is None or self.limits.rest is None:
            return
        columns = self._columns_of(len(last))
        rest_pose = columns.still(last)
        last = rest_pose.copy()
        for i, number in enumerate(self.limits.rest):
            if number is not None:
                rest_pose[i] = number

        # Of equal rotations, the nearest numbers let a robot that interpolates numbers turn the
        # short way.
        nearest = columns.nearest(rest_pose, last)
        low, high, *_ = self._limits_of(len(last))
        if ((low <= nearest) & (nearest <= high)).all():
            rest_pose = nearest

        ease = self.ease_in(last, rest_pose, far=True)
        yield last  # the motion begins at rest
        while ease is not None and not ease.arrived:
            command, _ = ease.step(last, rest_pose, None, 1)
            yield command

    def _columns_of(self, dim: int) -> Columns:
        """Return the meaning of the numbers of an action; raises the errors of `_limits_of`."""
        self._limits_of(dim)
        assert self._columns is not None  # noqa: S101 - set by `_limits_of`
        return self._columns

    def _limits_of(self, dim: int) -> list[list[float]]:
        """Return the limits of each number of an action (see `_limits`), and determine the meaning
        of the numbers.

        Args:
            dim: The number of values in an action.

        Raises:
            ConfigError: The limits do not fit the contract's description of the actions.
        """
        if self._columns is not None and self._columns.dim == dim:
            return self._limits

        limits = self.limits or MotionLimits()
        tick_s = 1.0 / (self.hz or 1.0)
        columns = Columns.from_spec(self._spec, dim, self._arm)
        if self._measure is not None and len(columns.absolute) == len(columns.grippers):
            raise _not_measurable()

        low = self._per_number("low", -math.inf if self._low is None else self._low, dim)
        high = self._per_number("high", math.inf if self._high is None else self._high, dim)
        if any(low_i > high_i for low_i, high_i in zip(low, high, strict=True)):
            raise ConfigError(f"low and high: expected low below high, got {low} and {high}")

        turns = [rotation.columns for rotation in columns.rotations]
        differences = {
            "max_step": (self._max_step, 0),
            "velocity": (limits.velocity, 1),
            "acceleration": (limits.acceleration, 2),
            "jerk": (limits.jerk, 3),
        }
        all_limits = [low, high]
        for name, (limit, order) in differences.items():
            per_s = self._per_number(name, math.inf if limit is None else limit, dim)
            per_tick = [_tolerant(number * tick_s**order) for number in per_s]
            for turn in turns:
                strictest = min(per_tick[i] for i in turn)
                per_tick[turn[0] : turn[-1] + 1] = [strictest] * len(turn)
            all_limits.append(per_tick)
        if limits.first is not None:
            self._per_number("first", limits.first, dim)
        self._check_positions(limits, columns)

        self._columns, self._limits, self._turns = columns, all_limits, turns
        self._numbers = [i for i in range(dim) if not any(i in turn for turn in turns)]
        return self._limits

    def _per_number(self, name: str, limit: object, dim: int) -> list[float]:
        """Return a limit for each number of an action; raises `ConfigError` if it has another
        number of values.
        """
        values = np.asarray(limit, np.float64)
        if values.ndim > 1 or (values.ndim == 1 and len(values) != dim):
            raise ConfigError(
                f"limits: {name}: expected one number, or {dim} as an action has, got "
                f"{values.tolist()}"
            )
        return np.broadcast_to(values, dim).tolist()  # type: ignore[no-any-return]

    def _check_positions(self, limits: MotionLimits, columns: Columns) -> None:
        """Raise `ConfigError` if a limit of positions has no effect, or would move a gripper."""
        if limits.rest is not None and len(limits.rest) != columns.dim:
            raise ConfigError(
                f"rest: expected {columns.dim} numbers, as an action has, got {len(limits.rest)}"
            )
        rest_pose = limits.rest or ()
        moved_grippers = [i for i in columns.grippers if rest_pose and rest_pose[i] is not None]
        if moved_grippers:
            raise ConfigError(
                f"rest: expected null for the grippers, numbers {moved_grippers}, as the motion to "
                f"rest keeps their grasp; got {limits.rest}"
            )
        for rotation in columns.rotations:
            numbers = [rest_pose[i] for i in rotation.columns] if rest_pose else []
            if None in numbers and numbers.count(None) < len(numbers):
                raise ConfigError(
                    f"rest: expected all or none of the numbers {rotation.columns} of a rotation, "
                    f"got {numbers}; a part of a rotation is no pose"
                )
        if not columns.relative:
            return

        relative = list(columns.relative)
        without_effect = []
        for name in ("workspace_low", "workspace_high"):
            if getattr(limits, name) is not None:
                without_effect.append(name)
        if limits.rest is not None and any(limits.rest[i] is not None for i in relative):
            without_effect.append("rest")
        if limits.first is not None and len(columns.absolute) == len(columns.grippers):
            without_effect.append("first")
        for name in ("low", "high"):
            bound = getattr(limits, name)
            if (
                bound is not None
                and np.isfinite(np.broadcast_to(bound, columns.dim)[relative]).any()
            ):
                without_effect.append(name)
        if without_effect:
            raise ConfigError(
                "limits: expected only velocity, acceleration and jerk for relative actions, "
                f"which cannot be compared with a position, got {', '.join(without_effect)}; "
                f"remove these limits"
            )

    def _softness(self) -> float:
        """Return the share of the limits of speed, acceleration and jerk that applies now."""
        if self._ticks_with_motion >= self._soft_ticks:
            return 1.0
        return 0.5 + 0.5 * self._ticks_with_motion / self._soft_ticks

    def _sizes(self, difference: Sequence[float]) -> Iterator[tuple[int, float]]:
        """Yield the first column of each number or rotation, and the size of its difference."""
        for i in self._numbers:
            yield i, abs(difference[i])
        for turn in self._turns:
            yield turn[0], math.hypot(*(difference[i] for i in turn))

    def _check_steps(
        self, columns: Columns, numbers: list[float], last_numbers: list[float]
    ) -> None:
        """Raise `InvalidAction` if an action is farther than `max_step` from the one before."""
        if self._max_step is None:
            return
        steps = self._limits[2]
        differences = columns.step(numbers, last_numbers)
        for i in self._numbers:
            if abs(differences[i]) > steps[i]:
                self._check_step(i, abs(differences[i]), numbers, last_numbers)
        for turn in self._turns:
            size = math.hypot(*(differences[i] for i in turn))
            self._check_step(turn[0], size, numbers, last_numbers)

    def _check_step(
        self, i: int, size: float, numbers: list[float], last_numbers: list[float]
    ) -> None:
        """Raise `InvalidAction` if the difference of a number or a rotation exceeds `max_step` by
        more than its rounding.
        """
        limit = self._limits[2][i]
        if size > limit + 2 * _ROUNDING * max(abs(numbers[i]), abs(last_numbers[i])):
            raise InvalidAction(
                f"action[{i}]: expected a step of at most max_step, {limit:.3g}, got "
                f"{numbers[i]:g} after {last_numbers[i]:g}, {size:.3g} away",
                cause="max_step",
            )

    def _check_dynamics(
        self, columns: Columns, numbers: list[float], last_numbers: list[float]
    ) -> tuple[list[float], list[float]]:
        """Check the speed, acceleration and jerk of this tick's motion.

        Args:
            columns: The meaning of the numbers.
            numbers: The numbers of the action.
            last_numbers: The numbers of the action or pose from which the motion begins.

        Returns:
            The speeds, and the changes of the speeds.

        Raises:
            InvalidAction: The motion exceeds a limit.
        """
        zeros = [0.0] * len(numbers)
        if last_numbers == self._accepted:  # the motion continues from the last action
            last_speeds, last_changes = self._speeds, self._changes
        else:
            last_speeds, last_changes = columns.motion(last_numbers, last_numbers), zeros

        speeds = columns.motion(numbers, last_numbers)
        changes = [speed - last for speed, last in zip(speeds, last_speeds, strict=True)]
        jerks = [change - last for change, last in zip(changes, last_changes, strict=True)]

        velocity_limits, acceleration_limits, jerk_limits = self._limits[3:]
        share = self._softness()
        for i in self._numbers:
            # A speed contains the float32 rounding error of two actions; each further difference
            # doubles the error.
            speed, last_speed = speeds[i], last_speeds[i]
            rounding = 2 * _ROUNDING * max(abs(numbers[i]), abs(last_numbers[i]))
            limit = share * velocity_limits[i]
            if abs(speed) > limit + rounding:
                raise self._refusal("velocity", i, speed, limit, 1)

            is_braking = abs(speed) <= abs(last_speed) and speed * last_speed >= 0.0
            if is_braking:
                continue

            limit = share * acceleration_limits[i]
            if abs(changes[i]) > limit + 2 * rounding:
                raise self._refusal("acceleration", i, changes[i], limit, 2)

            limit = share * jerk_limits[i]
            if abs(jerks[i]) > limit + 4 * rounding:
                raise self._refusal("jerk", i, jerks[i], limit, 3)

        for turn in self._turns:
            self._check_turn(turn, share, numbers, (last_speeds, speeds, changes, jerks))

        return speeds, changes

    def _record(self, numbers: list[float], speeds: list[float], changes: list[float]) -> None:
        """Record the motion of an accepted action."""
        has_moved = any(speeds)
        # After a tick at rest, an earlier deceleration no longer counts.
        self._changes = changes if has_moved else [0.0] * len(numbers)
        self._accepted = numbers
        self._speeds = speeds
        self._ticks_with_motion += has_moved

    def _check_turn(
        self,
        turn: tuple[int, ...],
        share: float,
        numbers: list[float],
        differences: tuple[list[float], list[float], list[float], list[float]],
    ) -> None:
        """Check the speed, acceleration and jerk of a rotation, whose differences are vectors.

        Args:
            turn: The columns of the rotation.
            share: The share of the limits that applies.
            numbers: The numbers of the action.
            differences: The speeds of the last and this tick, the changes of the speeds, and the
                changes of these changes.

        Raises:
            InvalidAction: The motion exceeds a limit.
        """
        first = turn[0]
        last_speed, speed, change, jerk = ([of[i] for i in turn] for of in differences)
        # The error of an angle is that of the numbers, which are at most pi or a few turns.
        rounding = 4 * _ROUNDING * max(1.0, *(abs(numbers[i]) for i in turn))
        size, last_size = math.hypot(*speed), math.hypot(*last_speed)
        velocity_limits, acceleration_limits, jerk_limits = self._limits[3:]
        limit = share * velocity_limits[first]
        if size > limit + rounding:
            raise self._refusal("velocity", first, size, limit, 1)

        # Braking shortens the vector; only a change of its direction is limited.
        along = sum(now * last for now, last in zip(speed, last_speed, strict=True))
        is_braking = size <= last_size and along >= 0.0
        if is_braking and last_size > 0.0:
            part = along / last_size**2
            change = [now - part * last for now, last in zip(speed, last_speed, strict=True)]

        limit = share * acceleration_limits[first]
        if math.hypot(*change) > limit + 2 * rounding:
            raise self._refusal("acceleration", first, math.hypot(*change), limit, 2)
        limit = share * jerk_limits[first]
        if not is_braking and math.hypot(*jerk) > limit + 4 * rounding:
            raise self._refusal("jerk", first, math.hypot(*jerk), limit, 3)

    def _refusal(
        self, quantity: str, i: int, value: float, limit: float, order: int
    ) -> InvalidAction:
        """Return the error for a number whose difference of order `order` exceeds its limit."""
        per_s = (self.hz or 1.0) ** order
        is_soft = self._ticks_with_motion < self._soft_ticks
        soft = ", lowered by the soft start" if is_soft else ""
        power = "/s" if order == 1 else f"/s^{order}"
        return InvalidAction(
            f"action[{i}]: expected {quantity} of at most {limit * per_s:.3g} "
            f"{self._unit_of(i)}{power}{soft}, got {value * per_s:.4g}",
            cause="max_step" if order == 1 else "dynamics",
        )

    def _unit_of(self, i: int) -> str:
        """Return the unit of a number of an action; "units" if the contract does not declare it."""
        columns = self._columns
        if columns is None or i in columns.grippers:
            return "units"
        return columns.units[i] or self._joint_unit or "units"

    def _check_workspace(self, limits: MotionLimits, tip: tuple[float, float, float]) -> None:
        """Raise `InvalidAction` if the tip, m, would leave the workspace."""
        for bound, sign, side in (
            (limits.workspace_low, 1, "below"),
            (limits.workspace_high, -1, "above"),
        ):
            for axis, position, limit in zip("xyz", tip, bound or tip, strict=True):
                if sign * (limit - position) > 0:
                    raise InvalidAction(
                        f"action: the tip would be at {axis} = {position:.3f} m, {side} the "
                        f"workspace's {limit:g} m",
                        cause="limits",
                    )


def measured_state(*names: str) -> Callable[[Obs], np.ndarray] | None:
    """Return a `measure` of a `Guard` that reads parts of the state.

    Args:
        names: The names of the parts in the order of an action, such as "joints", or "left/joints"
            and "right/joints"; without names, nothing is measured.

    Returns:
        The function, which raises `MissingState` if an observation lacks a part; None without
        names.
    """
    if not names:
        return None

    def measure(obs: Obs) -> np.ndarray:
        """Return these parts of the state, (D,)."""
        missing = [name for name in names if name not in obs.state]
        if missing:
            raise MissingState(missing[0], obs.state)
        return np.concatenate([obs.state[name] for name in names])

    return measure


def _joint_unit(contract: Contract | None) -> str | None:
    """Return the unit of commanded joints, which is the unit of the measured joints; None if the
    contract does not declare it.
    """
    if contract is None or contract.action.space != "joint":
        return None
    units = set()
    for name, part in (contract.state or {}).items():
        if name.rpartition("/")[2] == "joints":  # the name of the part without the arm's name
            units.add(part.unit)
    return units.pop() if len(units) == 1 else None


def _not_measurable() -> ConfigError:
    return ConfigError(
        "measure: expected None for relative actions, which cannot be compared with a pose, got a "
        "function; leave it out"
    )


def _strictest(
    name: str,
    stricter: np.ufunc,
    spec: ActionSpec,
    *bounds: float | np.ndarray | tuple[float, ...] | None,
) -> np.ndarray | None:
    """Return the strictest of the bounds; None if all bounds are None. The result is float32 like
    the actions, so that a bound of 0.1 accepts 0.1.

    Raises:
        ConfigError: A bound is NaN, or the bounds have different numbers of values.
    """
    arrays = [np.asarray(bound, np.float32) for bound in bounds if bound is not None]
    if any(np.isnan(array).any() for array in arrays):
        raise ConfigError(f"{name}: expected numbers, got {bounds}")

    sizes = {len(array) for array in arrays if array.ndim == 1}
    if spec.dim is not None:
        sizes.add(spec.dim)
    if len(sizes) > 1 or any(array.ndim > 1 for array in arrays):
        shapes = [array.shape for array in arrays]
        dim = "the same number" if spec.dim is None else f"{spec.dim} numbers"
        raise ConfigError(
            f"{name}: expected one number, or {dim} for an action, from the contract, the guard "
            f"and the limits, got the shapes {shapes}; give one bound for each number of an action"
        )
    return functools.reduce(stricter, arrays) if arrays else None


def _largest(is_allowed: Callable[[float], bool]) -> float:
    """Return the largest allowed share of a way, in [0, 1], by bisection."""
    allowed, too_far = 0.0, 1.0
    for _ in range(_BISECTIONS):
        share = 0.5 * (allowed + too_far)
        if is_allowed(share):
            allowed = share
        else:
            too_far = share
    return allowed


def _tolerant(limit: float) -> float:
    """Return a limit with a tolerance, since float32 rounds a step of 0.1 to a slightly larger
    value.
    """
    return limit * (1 + 1e-4) + 1e-6
