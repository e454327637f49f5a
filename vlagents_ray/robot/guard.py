"""The guard: the check of every action before it reaches a robot."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from vlagents_ray.chunking.ease import EaseIn
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


class Guard:
    """A check that accepts an action or raises `InvalidAction`; it never clips an action, since a
    clipped action is a different motion.

    The guard checks the action's shape, that its numbers are finite and within the bounds, and that
    it is not too far from the previous action. The first action has no previous action, and after a
    stop the arm may not be where the last action commanded it. With `measure`, the first action and
    an action after a stop are compared with the measured pose, and their grippers with the last
    command. Without `measure`, the first absolute action may be anywhere within the bounds, and an
    action after a stop is compared with the last action. Relative actions are compared with zero,
    i.e. no motion; their grippers, which are positions, are compared with the last command.

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
            e.g. `lambda obs: obs.state["joints"]`; not for relative actions.
        limits: The limits of the robot's motion, or the path that `MotionLimits.read` reads.
        hz: The control rate, Hz; needed with `limits`.
        soft_start_s: The time of motion, s, during which the limits of speed, acceleration and jerk
            rise from half of their values to the full values, since most accidents happen in the
            first minutes of a new checkpoint; 0 disables the soft start.

    Raises:
        ConfigError: A bound is NaN, `max_step` is negative, `measure` is given for relative
            actions, `limits` is given without `hz`, or a limit has no effect on the actions of the
            contract.
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

        bounds = limits or MotionLimits()
        self._low = _strictest("low", np.maximum, spec.low, low, bounds.low)
        self._high = _strictest("high", np.minimum, spec.high, high, bounds.high)
        self._max_step = None if max_step is None else np.asarray(max_step, np.float64)

        # This also rejects NaN, which would accept any step.
        if self._max_step is not None and not (self._max_step >= 0).all():
            raise ConfigError(f"max_step: expected a number of 0 or more, or None, got {max_step}")
        if measure is not None and spec.relative:
            raise ConfigError(
                "measure: expected None for relative actions, which cannot be compared with a "
                "pose, got a function; leave it out"
            )
        if limits is not None and (hz is None or not hz > 0 or not soft_start_s >= 0):
            raise ConfigError(
                "limits: expected a control rate above 0 Hz, and a soft start of 0 s or more, "
                f"got hz={hz}, soft_start_s={soft_start_s}"
            )

        self._measure = measure
        self._soft_ticks = soft_start_s * (hz or 0.0)
        self._ticks_with_motion = 0

        # The limits low, high, max_step, velocity, acceleration and jerk, each with a value for
        # each number of an action, in the action's units and in ticks.
        self._columns: list[list[float]] = []
        self._grippers: list[int] = []  # the indices of the grippers in an action
        self._deltas: list[int] = []  # the indices of the relative numbers

        self._accepted: list[float] | None = None  # the last accepted action; None at rest
        # speeds: differences between the last accepted action and the action before, units per
        # tick.
        self._speeds: list[float] = []
        self._changes: list[float] = []  # differences between these speeds and the speeds before
        if self._dim is not None:
            self._limits_of(self._dim)

    def reference(self, obs: Obs, last: np.ndarray | None) -> np.ndarray | None:
        """Return the pose with which the first action, or the first action after a stop, is
        compared.

        Args:
            obs: The current observation.
            last: The last commanded action, (D,); None before the first action.

        Returns:
            The measured pose, (D,) float32; `last` if the guard has no `measure`.

        Raises:
            ConfigError: `measure` returns another number of values than an action has.
            InvalidAction: `measure` returns NaN or infinity, so that no action can be checked.
        """
        self._accepted = None
        if last is not None and self._spec.relative:
            self._limits_of(len(last))
            standing = last.copy()
            standing[self._deltas] = 0.0  # zeros: the robot does not move
            return standing
        if self._measure is None:
            return last

        pose = np.array(self._measure(obs), np.float32)
        dim = self._dim if last is None else len(last)
        if pose.ndim != 1 or dim not in (None, len(pose)):
            raise ConfigError(
                f"measure: expected the shape of an action, ({dim or 'D'},), got {pose.shape}; "
                "return one number for each number of an action"
            )
        if not np.isfinite(pose).all():
            raise InvalidAction(
                f"measure: expected finite numbers, got {pose.tolist()}; the robot's sensors are "
                "broken"
            )

        if last is not None:
            self._limits_of(len(last))
            # Grippers keep their last command, since commanding the measured opening would loosen
            # the grasp.
            pose[self._grippers] = last[self._grippers]
        return pose

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

        low, high, steps, *dynamic_limits = self._limits_of(len(numbers))
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
            last_numbers = numbers.copy()
            for i in self._deltas:
                last_numbers[i] = 0.0
        else:
            last_numbers = last.tolist()

        for i, (number, last_number) in enumerate(zip(numbers, last_numbers, strict=True)):
            rounding = 2 * _ROUNDING * max(abs(number), abs(last_number))
            if abs(number - last_number) > steps[i] + rounding:
                raise InvalidAction(
                    f"action[{i}]: expected a step of at most max_step, {steps[i]:.3g}, got "
                    f"{number:g} after {last_number:g}",
                    cause="max_step",
                )
        if self.limits is not None:
            self._check_dynamics(numbers, last_numbers, dynamic_limits)
        return action

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
        if self.limits is None or (start is None and not self._spec.relative):
            return None
        *_, velocity, acceleration, jerk = self._limits_of(len(goal))
        if start is None:  # actions are relative, and the positions of the grippers are unknown
            start = goal
        if start.shape != goal.shape:
            return None
        if not (far or self._spec.relative):
            self._check_first(self.limits, start, goal, velocity)
        dynamic_limits = (self.limits.velocity, self.limits.acceleration, self.limits.jerk)
        if all(limit is None for limit in dynamic_limits):
            return None

        # Grippers without limits jump to their position.
        at_once = []
        for i in self._grippers:
            if velocity[i] == acceleration[i] == jerk[i] == math.inf:
                at_once.append(i)

        distances = np.abs(goal.astype(np.float64) - start)
        distances[self._deltas + at_once] = 0.0
        plan_speeds = self._plan_speeds(goal if plan is None else plan).tolist()
        share = self._softness()
        ramp_ticks = 0.0
        approach_ticks = 0.0
        for i, distance in enumerate(distances.tolist()):
            max_speed = share * velocity[i]
            max_acceleration = share * acceleration[i]
            max_jerk = share * jerk[i]

            if i not in at_once:
                # The other half of the acceleration and jerk remains for the policy's own motion.
                speed = max_speed if max_speed < math.inf else 2 * plan_speeds[i]
                ramp_ticks = max(ramp_ticks, 2 * speed / max_acceleration, 2 * speed / max_jerk)

            # The peaks of the quintic over T ticks: 1.875 D / T, 5.7735 D / T^2, 60 D / T^3.
            fastest_ticks = max(
                1.875 * distance / max_speed,
                math.sqrt(5.7735 * distance / max_acceleration),
                (60 * distance / max_jerk) ** (1 / 3),
            )
            approach_ticks = max(approach_ticks, _SLOWNESS * fastest_ticks)

        ticks = math.ceil(approach_ticks)
        if not self._deltas:
            ticks = max(1, ticks)
        even_ramp_ticks = 2 * math.ceil(ramp_ticks / 2)
        return EaseIn(start, ticks, even_ramp_ticks, deltas=self._deltas, at_once=at_once)

    def _check_first(
        self, limits: MotionLimits, start: np.ndarray, goal: np.ndarray, velocity: list[float]
    ) -> None:
        """Raise `InvalidAction` if the first action is too far from the pose at rest."""
        dim, hz = len(goal), self.hz or 0.0
        if limits.first is None:
            allowed = [limit * hz * _FIRST_S for limit in velocity]
        else:
            allowed = np.broadcast_to(np.asarray(limits.first, np.float64), dim).tolist()

        for i, (begin, end) in enumerate(zip(start.tolist(), goal.tolist(), strict=True)):
            distance = abs(end - begin)
            if distance > allowed[i] + 2 * _ROUNDING * max(abs(begin), abs(end)):
                raise InvalidAction(
                    f"action[{i}]: expected a first action at most {allowed[i]:.3g} from the pose "
                    f"{begin:g}, got {end:g}, {distance:g} away; check that the policy is for "
                    "this arm, and the order and units of the joints; if all are right, raise "
                    "`first`",
                    cause="max_step",
                )

    def _plan_speeds(self, plan: np.ndarray) -> np.ndarray:
        """Return the largest speed of each number in the rows of a plan, (D,) units per tick."""
        rows = np.atleast_2d(plan).astype(np.float64)
        speeds: np.ndarray = np.abs(np.diff(rows, axis=0)).max(0, initial=0.0)
        speeds[self._deltas] = np.abs(rows[:, self._deltas]).max(0)
        return speeds

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
        self._limits_of(len(last))
        rest_pose = last.copy()
        for i, number in enumerate(self.limits.rest):
            if number is not None:
                rest_pose[i] = number

        ease = self.ease_in(last, rest_pose, far=True)
        yield last  # the motion begins at rest
        while ease is not None and not ease.arrived:
            command, _ = ease.step(rest_pose, None, 1)
            yield command

    def _limits_of(self, dim: int) -> list[list[float]]:
        """Return the limits of each number of an action (see `_columns`), and determine the indices
        of grippers and relative numbers.

        Args:
            dim: The number of values in an action.

        Raises:
            ConfigError: The limits do not fit the contract's description of the actions.
        """
        if self._columns and len(self._columns[0]) == dim:
            return self._columns

        limits = self.limits or MotionLimits()
        tick_s = 1.0 / (self.hz or 1.0)
        self._grippers = self._spec.gripper_columns(dim)
        self._deltas = self._spec.delta_columns(dim)
        try:
            columns = [
                np.broadcast_to(-math.inf if self._low is None else self._low, dim).tolist(),
                np.broadcast_to(math.inf if self._high is None else self._high, dim).tolist(),
                _tolerant(math.inf if self._max_step is None else self._max_step, dim),
            ]
            dynamic_limits = (limits.velocity, limits.acceleration, limits.jerk)
            for order, limit in enumerate(dynamic_limits, 1):
                per_s = math.inf if limit is None else np.asarray(limit, np.float64)
                columns.append(_tolerant(per_s * tick_s**order, dim))
            np.broadcast_to(0.0 if limits.first is None else limits.first, dim)
        except ValueError as error:
            raise ConfigError(
                f"limits: expected one number, or {dim} as an action has: {error}"
            ) from error

        low, high = columns[:2]
        if any(low_i > high_i for low_i, high_i in zip(low, high, strict=True)):
            raise ConfigError(f"low and high: expected low below high, got {low} and {high}")
        self._check_positions(limits, dim)
        self._columns = columns
        return self._columns

    def _check_positions(self, limits: MotionLimits, dim: int) -> None:
        """Raise `ConfigError` if a limit of positions has no effect, or would move a gripper."""
        if limits.rest is not None and len(limits.rest) != dim:
            raise ConfigError(
                f"rest: expected {dim} numbers, as an action has, got {len(limits.rest)}"
            )
        rest_pose = limits.rest or ()
        moved_grippers = [i for i in self._grippers if rest_pose and rest_pose[i] is not None]
        if moved_grippers:
            raise ConfigError(
                f"rest: expected null for the grippers, numbers {moved_grippers}, as the motion to "
                f"rest keeps their grasp; got {limits.rest}"
            )
        if not self._deltas:
            return

        positions = ("first", "rest", "workspace_low", "workspace_high")
        without_effect = [name for name in positions if getattr(limits, name) is not None]
        for name in ("low", "high"):
            bound = getattr(limits, name)
            if bound is not None and np.isfinite(np.broadcast_to(bound, dim)[self._deltas]).any():
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

    def _check_dynamics(
        self, numbers: list[float], last_numbers: list[float], limits: Sequence[list[float]]
    ) -> None:
        """Check the speed, acceleration and jerk of this tick's motion, and record it.

        Args:
            numbers: The numbers of the action.
            last_numbers: The numbers of the action or pose from which the motion begins.
            limits: The limits of velocity, acceleration and jerk of each number, per tick.

        Raises:
            InvalidAction: The motion exceeds a limit.
        """
        velocity_limits, acceleration_limits, jerk_limits = limits
        zeros = [0.0] * len(numbers)
        if last_numbers == self._accepted:  # the motion continues from the last action
            last_speeds, last_changes = self._speeds, self._changes
        else:
            last_speeds, last_changes = zeros.copy(), zeros

        pairs = zip(numbers, last_numbers, strict=True)
        speeds = [number - last_number for number, last_number in pairs]
        for i in self._deltas:
            speeds[i] = numbers[i]
            last_speeds[i] = last_numbers[i]
        changes = [speed - last for speed, last in zip(speeds, last_speeds, strict=True)]

        share = self._softness()
        for i, speed in enumerate(speeds):
            # A speed contains the float32 rounding error of two actions; each further difference
            # doubles the error.
            rounding = 2 * _ROUNDING * max(abs(numbers[i]), abs(last_numbers[i]))
            limit = share * velocity_limits[i]
            if abs(speed) > limit + rounding:
                raise self._refusal("velocity", i, speed, limit, 1)

            last_speed = last_speeds[i]
            is_braking = abs(speed) <= abs(last_speed) and speed * last_speed >= 0.0
            if is_braking:
                continue

            change = changes[i]
            limit = share * acceleration_limits[i]
            if abs(change) > limit + 2 * rounding:
                raise self._refusal("acceleration", i, change, limit, 2)

            jerk = change - last_changes[i]
            limit = share * jerk_limits[i]
            if abs(jerk) > limit + 4 * rounding:
                raise self._refusal("jerk", i, jerk, limit, 3)

        has_moved = any(speeds)
        # After a tick at rest, an earlier deceleration no longer counts.
        self._changes = changes if has_moved else zeros
        self._accepted = numbers
        self._speeds = speeds
        self._ticks_with_motion += has_moved

    def _refusal(
        self, quantity: str, i: int, value: float, limit: float, order: int
    ) -> InvalidAction:
        """Return the error for a number whose difference of order `order` exceeds its limit."""
        per_s = (self.hz or 1.0) ** order
        is_soft = self._ticks_with_motion < self._soft_ticks
        soft = ", lowered by the soft start" if is_soft else ""
        return InvalidAction(
            f"action[{i}]: expected {quantity} of at most {limit * per_s:.3g} "
            f"(units/s^{order}{soft}), got {value * per_s:.4g}",
            cause="max_step" if order == 1 else "dynamics",
        )

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


def measured_state(name: str | None) -> Callable[[Obs], np.ndarray] | None:
    """Return a `measure` of a `Guard` that reads a part of the state.

    Args:
        name: The name of the part, such as "joints"; None measures nothing.

    Returns:
        The function, which raises `MissingState` if an observation lacks the part; None without a
        name.
    """
    if name is None:
        return None

    def measure(obs: Obs) -> np.ndarray:
        """Return that part of the state, (D,)."""
        if name not in obs.state:
            raise MissingState(name, obs.state)
        return obs.state[name]

    return measure


def _strictest(
    name: str, stricter: np.ufunc, *bounds: float | np.ndarray | tuple[float, ...] | None
) -> np.ndarray | None:
    """Return the strictest of the bounds; None if all bounds are None. The result is float32 like
    the actions, so that a bound of 0.1 accepts 0.1.
    """
    arrays = [np.asarray(bound, np.float32) for bound in bounds if bound is not None]
    if any(np.isnan(array).any() for array in arrays):
        raise ConfigError(f"{name}: expected numbers, got {bounds}")
    return functools.reduce(stricter, arrays) if arrays else None


def _tolerant(limit: float | np.ndarray, dim: int) -> list[float]:
    """Return the limit of each number with a tolerance, since float32 rounds a step of 0.1 to a
    slightly larger value.
    """
    return (np.broadcast_to(limit, dim) * (1 + 1e-4) + 1e-6).tolist()  # type: ignore[no-any-return]
