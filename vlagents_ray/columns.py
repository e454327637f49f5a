"""The meaning of each column of an action, and the arithmetic that follows from it.

An action is a row of numbers, and its columns differ: joint angles, positions, rotations in several
representations and grippers, each as a target or as a motion. `Columns` is made from the contract
of a policy and, if known, the contract of the arm. It answers which row is no motion, which row
lies between two rows, and how fast a row moves the robot. The chunk player, the guard, the
operator's devices and the clock of an evaluation compute with rows only by its methods.

Rotations are computed as unit quaternions (w, x, y, z). Euler angles are rotations about the fixed
axes x, y and z, in this order, as in URDF and ROS. The 6D representation contains the first two
columns of the rotation matrix (Zhou et al. 2019, https://arxiv.org/abs/1812.07035). Its fractions,
means and angles are the same for the first two rows.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vlagents_ray.contract import ActionSpec, Rotation
from vlagents_ray.errors import ConfigError, InvalidAction

_WIDTHS: Mapping[str, int] = {
    "euler_xyz": 3,
    "axis_angle": 3,
    "quat_xyzw": 4,
    "quat_wxyz": 4,
    "rot6d": 6,
}
_IDENTITIES: Mapping[str, tuple[float, ...]] = {
    "euler_xyz": (0.0, 0.0, 0.0),
    "axis_angle": (0.0, 0.0, 0.0),
    "quat_xyzw": (0.0, 0.0, 0.0, 1.0),
    "quat_wxyz": (1.0, 0.0, 0.0, 0.0),
    "rot6d": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
}
# Shorter vectors have no direction: a network's quaternion has a length near 1.
_SHORTEST = 1e-6

_Quaternion = tuple[float, float, float, float]


class RotationColumns(NamedTuple):
    """The columns of one rotation in an action."""

    columns: tuple[int, ...]  # consecutive columns, rising
    kind: Rotation
    is_relative: bool  # whether the rotation is a motion, not a target
    # Whether the numbers of a motion are proportional to it: angular velocities, and angles that
    # the robot multiplies by a factor. Such numbers are scaled and added without conversion.
    is_linear: bool
    is_of_tool: bool  # whether a relative rotation is about the axes of the tool, not the base

    @property
    def start(self) -> int:
        """The first column."""
        return self.columns[0]

    @property
    def stop(self) -> int:
        """The column after the last one."""
        return self.columns[-1] + 1


@dataclass(frozen=True, slots=True)
class Columns:
    """The columns of actions with `dim` numbers; see `from_spec`.

    All methods accept and return rows, (D,), and never change their arguments.
    """

    dim: int
    # Columns that are motions: deltas and velocities. A row of zeros, or of rotations by no angle,
    # is no motion in these columns.
    relative: tuple[int, ...]
    absolute: tuple[int, ...]  # all other columns: targets; a gripper is always a target
    grippers: tuple[int, ...]
    rotations: tuple[RotationColumns, ...]
    gripper_open: float | None = None  # the value that opens a gripper
    gripper_closed: float | None = None  # the value that closes a gripper
    is_known: bool = True
    """Whether the contract declares which columns are motions.

    If it does not, all columns count as targets.
    """
    units: tuple[str | None, ...] = ()
    """The unit of each column, such as "m" or "rad"; None if it is unknown."""

    @classmethod
    def from_spec(cls, spec: ActionSpec, dim: int, arm: ActionSpec | None = None) -> Columns:
        """Return the columns of a policy's actions.

        Args:
            spec: The actions of the policy's contract.
            dim: The number of values in an action.
            arm: The actions of the arm's contract, which may declare further grippers, also by the
                names of its motors.

        Raises:
            ConfigError: The contract has no meaning for this number of values, or contradicts
                itself.
        """
        return _from_spec(spec, dim, arm)

    def still(self, last: np.ndarray | None = None) -> np.ndarray:
        """Return a row without motion, (D,) float32: the targets of `last`, and no motion.

        Args:
            last: The last command, (D,); None for targets of 0, which is only valid for rows
                without targets.
        """
        row = np.zeros(self.dim, np.float32) if last is None else np.array(last, np.float32)
        row[list(self.relative)] = 0.0
        for rotation in self.rotations:
            if rotation.is_relative:
                row[rotation.start : rotation.stop] = _IDENTITIES[rotation.kind]
        return row

    def first_still(self, opening: float | None) -> np.ndarray | None:
        """Return a row without motion before any command, (D,) float32.

        Args:
            opening: The opening of the grippers in [0, 1], where 1 is open; None if it is unknown.

        Returns:
            The row; None if a target is unknown.
        """
        if len(self.absolute) > len(self.grippers):
            return None
        row = self.still()
        if self.grippers:
            command = None if opening is None else self.gripper_command(opening)
            if command is None:
                return None
            row[list(self.grippers)] = command
        return row

    def gripper_command(self, opening: float) -> float | None:
        """Return the command for an opening of a gripper in [0, 1], where 1 is open; None if the
        contracts do not declare the values that it needs.
        """
        if opening in (0.0, 1.0):
            return self.gripper_open if opening else self.gripper_closed
        if self.gripper_open is None or self.gripper_closed is None:
            return None
        return self.gripper_closed + opening * (self.gripper_open - self.gripper_closed)

    @property
    def gripper_middle(self) -> float | None:
        """The command between an open and a closed gripper; None if one of them is unknown."""
        return self.gripper_command(0.5)

    def travel(self, start: np.ndarray, goal: np.ndarray, begin: float, end: float) -> np.ndarray:
        """Return the command for a part of the way from one row of a plan to the next.

        Args:
            start: The row at which the way begins, (D,).
            goal: The row at which the way ends, (D,).
            begin: The fraction of the way at which the part begins, in [0, 1].
            end: The fraction of the way at which the part ends, in [begin, 1].

        Returns:
            (D,) float32: the target at `end`, and the motions of `goal` from `begin` to `end`.
        """
        if begin == 0.0 and end == 1.0:
            return np.array(goal, np.float32)
        # The difference of two float32 is exact enough, and the target at the end is exact.
        row = goal if end == 1.0 else start + end * (goal - start)
        row = np.array(row, np.float32)
        share = end - begin
        if self.relative:
            columns = list(self.relative)
            row[columns] = share * goal[columns]
        for rotation in self.rotations:
            part = slice(rotation.start, rotation.stop)
            goal_numbers = goal[part].tolist()
            if rotation.is_relative:
                row[part] = _fraction(rotation, goal_numbers, share)
            elif end != 1.0:
                row[part] = _between(rotation.kind, start[part].tolist(), goal_numbers, end)
        return row

    def nearest(self, row: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Return a row with the representations of its rotations that are nearest to another row,
        (D,) float32: a roll of pi and a roll of -pi are the same rotation.
        """
        same = np.array(row, np.float32)
        for rotation in self.rotations:
            if not rotation.is_relative:
                part = slice(rotation.start, rotation.stop)
                quaternion = _read(rotation.kind, row[part].tolist())
                same[part] = _write(rotation.kind, quaternion, near[part].tolist())
        return same

    def joined(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return the command that moves the robot as `first` and then `second` do, (D,) float32;
        or the pose after a row.

        In the frame of the tool, the first rotation also turns the second translation. If the
        numbers of the rotation have a factor, its angle is unknown, and the translations are added,
        which is right to first order.

        Args:
            first: A row, (D,), or the pose at which the robot executes `second`.
            second: A row, (D,), whose targets are those of the result.
        """
        row = np.array(second, np.float32)
        columns = list(self.relative)
        row[columns] = first[columns] + second[columns]
        for rotation in self._composed():
            part = slice(rotation.start, rotation.stop)
            numbers = first[part].tolist()
            begin = _read(rotation.kind, numbers)
            turn = _read(rotation.kind, second[part].tolist())
            product = (begin, turn) if rotation.is_of_tool else (turn, begin)
            row[part] = _write(rotation.kind, _product(*product), numbers)
            place = self._translation(rotation)
            if place is not None:
                row[place] = first[place] + _rotated(begin, second[place].tolist())
        return row

    def reversed(self, row: np.ndarray) -> np.ndarray:
        """Return the row that moves the robot back after a row, (D,) float32.

        Its targets are those of the row.
        """
        back = np.array(row, np.float32)
        columns = list(self.relative)
        back[columns] = -row[columns]
        for rotation in self._composed():
            part = slice(rotation.start, rotation.stop)
            turn = _inverse(_read(rotation.kind, row[part].tolist()))
            back[part] = _write(rotation.kind, turn, _IDENTITIES[rotation.kind])
            place = self._translation(rotation)
            if place is not None:
                back[place] = _rotated(turn, back[place].tolist())
        return back

    def remaining(self, whole: np.ndarray, executed: np.ndarray) -> np.ndarray:
        """Return the way that is left of a motion after another motion was executed, (D,) float32.

        Args:
            whole: The motion, (D,).
            executed: The executed motion, (D,).
        """
        if any(True for _ in self._composed()):
            return self.joined(self.reversed(executed), whole)
        left: np.ndarray = whole - executed
        return left

    def reach(self, rows: np.ndarray) -> np.ndarray:
        """Return the largest motion of each column in rows, (D,) float32; 0 for targets.

        The motion of a rotation, in all its columns, is its angle, rad, unless its numbers have a
        factor.

        Args:
            rows: (H, D).

        Raises:
            InvalidAction: Numbers of a row are no rotation.
        """
        reach = np.zeros(self.dim, np.float32)
        columns = list(self.relative)
        reach[columns] = np.abs(rows[:, columns]).max(0)
        for rotation in self._composed():
            part = slice(rotation.start, rotation.stop)
            reach[part] = max(_angle(rotation.kind, numbers) for numbers in rows[:, part].tolist())
        return reach

    def limited(self, row: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return a row with its motions within bounds, (D,) float32.

        Args:
            row: (D,).
            low: The lower bounds, (D,). Those of rotations are not used, unless the numbers of the
                rotation have a factor.
            high: The upper bounds, (D,). That of a rotation, in its first column, is for its angle,
                rad, unless its numbers have a factor.
        """
        limited = np.array(row, np.float32)
        columns = list(self.relative)
        limited[columns] = np.clip(row[columns], low[columns], high[columns])
        for rotation in self._composed():
            part = slice(rotation.start, rotation.stop)
            largest = float(high[rotation.start])
            numbers = row[part].tolist()
            identity = _IDENTITIES[rotation.kind]
            turn = _turn(rotation.kind, identity, numbers)
            angle = math.hypot(*turn)
            if angle > largest:
                shorter = _from_vector([largest / angle * number for number in turn])
                numbers = _write(rotation.kind, shorter, identity)
            limited[part] = numbers
        return limited

    def _composed(self) -> Iterator[RotationColumns]:
        """Yield the relative rotations whose products, not sums, are rotations."""
        for rotation in self.rotations:
            if rotation.is_relative and not rotation.is_linear:
                yield rotation

    def _translation(self, rotation: RotationColumns) -> slice | None:
        """Return the columns of the translation that a rotation about the axes of the tool turns;
        None if there are none.
        """
        columns = range(rotation.start - 3, rotation.start)
        if rotation.is_of_tool and all(column in self.relative for column in columns):
            return slice(columns.start, columns.stop)
        return None

    def mean(self, rows: Sequence[np.ndarray], weights: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the weighted mean of rows for the same tick, (D,) float32.

        Args:
            rows: The rows, (D,) each; the representation of a rotation is the nearest to the last.
            weights: The weight of each row, at least 0; their sum is above 0.
        """
        shares = np.asarray(weights)
        row = np.asarray((shares / shares.sum()) @ np.array(rows), np.float32)
        for rotation in self.rotations:
            if not rotation.is_linear:
                part = slice(rotation.start, rotation.stop)
                numbers = [row_of_tick[part].tolist() for row_of_tick in rows]
                quaternions = [_read(rotation.kind, of_row) for of_row in numbers]
                mean = _mean(quaternions, shares)
                row[part] = _write(rotation.kind, mean, numbers[-1])
        return row

    def step(self, row: Sequence[float], last: Sequence[float]) -> list[float]:
        """Return the difference between two rows, D numbers.

        The difference of a rotation is a rotation vector, rad, in the rotation's first three
        columns; its other columns are 0.

        Args:
            row: The numbers of a row.
            last: The numbers of the row before.
        """
        difference = [number - before for number, before in zip(row, last, strict=True)]
        for rotation in self.rotations:
            if not rotation.is_linear:
                start, stop = rotation.start, rotation.stop
                turn = _turn(rotation.kind, last[start:stop], row[start:stop])
                difference[start:stop] = _padded(turn, stop - start)
        return difference

    def motion(self, row: Sequence[float], last: Sequence[float]) -> list[float]:
        """Return how a row moves a robot that executed `last` before, D numbers per tick.

        These are the differences between targets, and the motions themselves. A rotation is a
        vector, as in `step`.

        Args:
            row: The numbers of a row.
            last: The numbers of the row before.
        """
        motion = [number - before for number, before in zip(row, last, strict=True)]
        for column in self.relative:
            motion[column] = row[column]
        for rotation in self.rotations:
            if not rotation.is_linear:
                start, stop = rotation.start, rotation.stop
                before = _IDENTITIES[rotation.kind] if rotation.is_relative else last[start:stop]
                turn = _turn(rotation.kind, before, row[start:stop])
                motion[start:stop] = _padded(turn, stop - start)
        return motion

    def moved(self, pose: np.ndarray, motion: Sequence[float]) -> np.ndarray:
        """Return the row that moves a robot from a pose, (D,) float32; the inverse of `motion`.

        Args:
            pose: The last command or the measured pose, (D,); its motions are not used.
            motion: The motion per tick, D numbers; a rotation is a vector, as in `step`.
        """
        row = self.still(pose) + np.asarray(motion, np.float32)
        for rotation in self.rotations:
            if not rotation.is_linear:
                start, stop = rotation.start, rotation.stop
                identity = _IDENTITIES[rotation.kind]
                numbers = identity if rotation.is_relative else pose[start:stop].tolist()
                turn = _from_vector(motion[start : start + 3])
                turned = _product(turn, _read(rotation.kind, numbers))
                row[start:stop] = _write(rotation.kind, turned, numbers)
        return row.astype(np.float32)

    def require_rotations(self, row: Sequence[float]) -> None:
        """Raise `InvalidAction` if numbers of a row are no rotation, such as a zero quaternion."""
        for rotation in self.rotations:
            _read(rotation.kind, row[rotation.start : rotation.stop])


@functools.lru_cache(maxsize=256)
def _from_spec(spec: ActionSpec, dim: int, arm: ActionSpec | None) -> Columns:
    """Return `Columns.from_spec`; the result is the same object for the same contracts."""
    _require_consistent(spec, dim)
    arm = arm or ActionSpec()
    grippers = sorted({*_grippers(spec, dim), *_grippers(arm, dim)})

    targets = {*(spec.absolute or ()), *grippers}
    velocities = {*_named(spec, dim, _is_velocity), *_named(arm, dim, _is_velocity)} - targets
    relative = []
    for column in range(dim):
        if column in velocities or (spec.relative and column not in targets):
            relative.append(column)
    rotations = tuple(_rotations(spec, dim, relative))
    for rotation in rotations:
        cut = sorted({*rotation.columns} & {*grippers})
        if cut:
            raise ConfigError(
                f"action.rotation: expected no gripper among the columns {rotation.columns} of "
                f"a rotation ({rotation.kind}), got the grippers {cut}; {_LOCATE}"
            )

    opened = arm.gripper_open if spec.gripper_open is None else spec.gripper_open
    closed = arm.gripper_closed if spec.gripper_closed is None else spec.gripper_closed
    return Columns(
        dim=dim,
        relative=tuple(relative),
        absolute=tuple(column for column in range(dim) if column not in relative),
        grippers=tuple(grippers),
        rotations=rotations,
        gripper_open=opened,
        gripper_closed=closed,
        is_known=spec.relative is not None,
        units=_units(spec, dim, grippers, rotations),
    )


_LOCATE = (
    "correct the contract's `rotation`, `dim` and `arms`, or set `rotation_columns`, the first "
    "column of each rotation"
)


def _require_consistent(spec: ActionSpec, dim: int) -> None:
    """Raise `ConfigError` if fields of a contract contradict each other."""
    if spec.absolute is not None and not spec.relative:
        raise ConfigError(
            "action.absolute: expected delta=True with it, as it names the targets among motions, "
            f"got delta={spec.delta}; set delta=True, or leave `absolute` out"
        )
    outside = [column for column in spec.absolute or () if not 0 <= column < dim]
    if outside:
        raise ConfigError(
            f"action.absolute: expected columns from 0 to {dim - 1}, got {outside}; correct "
            "`absolute` or `dim` of the contract"
        )

    has_rotation = spec.rotation not in (None, "none")
    if spec.rotation_columns is not None and not has_rotation:
        raise ConfigError(
            "action.rotation_columns: expected a `rotation` with them, got "
            f"rotation={spec.rotation!r}; set the representation of the rotations"
        )
    if has_rotation and spec.rotation_columns is None and spec.space == "joint":
        raise ConfigError(
            f"action.rotation: expected None for joints, got {spec.rotation!r}; leave it out, or "
            "set `rotation_columns` if poses are next to the joints"
        )
    if "velocity" in (spec.space or "") and _WIDTHS.get(spec.rotation or "", 3) != 3:
        raise ConfigError(
            f"action.rotation: expected 'axis_angle' or 'euler_xyz' for velocities, got "
            f"{spec.rotation!r}, which has no rate; declare the rotation of the velocities"
        )
    opened, closed = spec.gripper_open, spec.gripper_closed
    if opened is not None and opened == closed:
        raise ConfigError(
            f"action.gripper_open: expected another value than gripper_closed, got {opened} for "
            "both; correct the contract"
        )


def _grippers(spec: ActionSpec, dim: int) -> Iterator[int]:
    """Yield the columns of the grippers that a contract declares.

    These are its `grippers`, or else the columns with "gripper" in their names. Without names, they
    are the last columns of each arm's part, if the contract declares the value of an open or a
    closed gripper.
    """
    if spec.grippers is not None:
        outside = [column for column in spec.grippers if not 0 <= column < dim]
        if outside:
            raise ConfigError(
                f"action.grippers: expected columns from 0 to {dim - 1}, got {outside}; correct "
                "`grippers` or `dim` of the contract of the policy or the arm"
            )
        yield from spec.grippers
        return
    named = list(_named(spec, dim, _is_gripper))
    if named:
        yield from named
    elif spec.gripper_open is not None or spec.gripper_closed is not None:
        width = _width(spec, dim)
        yield from range(width - 1, dim, width)


def _named(spec: ActionSpec, dim: int, has_kind: Callable[[str], bool]) -> Iterator[int]:
    """Yield the columns whose names are of a kind, if the contract has a name for each column."""
    names = spec.names or ()
    if len(names) == dim:
        for column, name in enumerate(names):
            if has_kind(name.lower()):
                yield column


def _is_gripper(name: str) -> bool:
    return "gripper" in name


def _is_velocity(name: str) -> bool:
    """Return whether a name is that of a velocity, as LeRobot's "x.vel" of a mobile base."""
    return "velocity" in name or name.endswith(".vel")


def _width(spec: ActionSpec, dim: int) -> int:
    """Return the number of values of each arm."""
    arms = len(spec.arms or ("",))
    if dim % arms:
        raise ConfigError(
            f"action.arms: expected a number of values that {arms} arms {spec.arms} share "
            f"equally, got {dim}; correct `arms` or `dim` of the contract"
        )
    return dim // arms


def _rotations(spec: ActionSpec, dim: int, relative: Iterable[int]) -> Iterator[RotationColumns]:
    """Yield the rotations that a contract declares; raises `ConfigError` if they do not fit into a
    row.
    """
    kind = spec.rotation
    if kind is None or kind == "none":
        return
    starts = spec.rotation_columns
    if starts is None:  # after the three numbers of each arm's position
        starts = tuple(first + 3 for first in range(0, dim, _width(spec, dim)))

    taken: set[int] = set()
    for start in starts:
        columns = tuple(range(start, start + _WIDTHS[kind]))
        if start < 0 or columns[-1] >= dim or taken & {*columns}:
            raise ConfigError(
                f"action.rotation: expected columns {columns} for a rotation ({kind}), which has "
                f"{len(columns)} numbers, in an action of {dim} numbers; {_LOCATE}"
            )
        taken |= {*columns}

        are_relative = {column in relative for column in columns}
        if len(are_relative) > 1:
            raise ConfigError(
                f"action.absolute: expected all or none of the columns {columns} of a rotation "
                f"({kind}), got {spec.absolute}; a rotation is a target or a motion"
            )
        is_relative = are_relative.pop()
        is_scaled = (
            spec.low is not None or spec.high is not None or "velocity" in (spec.space or "")
        )
        yield RotationColumns(
            columns,
            kind,
            is_relative,
            is_relative and is_scaled and len(columns) == 3,
            spec.frame == "tool",
        )


def _units(
    spec: ActionSpec, dim: int, grippers: Iterable[int], rotations: Iterable[RotationColumns]
) -> tuple[str | None, ...]:
    """Return the unit of each column: "m" before a rotation, and "rad" in it.

    The numbers of joints may be degrees, and the numbers of a motion with bounds have a factor.
    """
    units: list[str | None] = [None] * dim
    for rotation in rotations:
        if not rotation.is_linear:
            units[rotation.start : rotation.stop] = ["rad"] * len(rotation.columns)
            if spec.low is None and spec.high is None:
                units[max(0, rotation.start - 3) : rotation.start] = ["m"] * min(3, rotation.start)
    for gripper in grippers:
        units[gripper] = None
    return tuple(units)


# Rotations as unit quaternions (w, x, y, z). Plain floats are faster than numpy for four numbers.


def _read(kind: Rotation, numbers: Sequence[float]) -> _Quaternion:
    """Return the rotation that numbers represent; raises `InvalidAction` if they represent none."""
    if kind == "axis_angle":
        return _from_vector(numbers)
    if kind == "euler_xyz":
        (roll, pitch, yaw) = numbers
        about_x = (math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0)
        about_y = (math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0)
        about_z = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        return _product(about_z, _product(about_y, about_x))
    if kind == "rot6d":
        return _from_two_axes(numbers)

    if kind == "quat_wxyz":
        w, x, y, z = numbers
    else:
        x, y, z, w = numbers
    length = math.hypot(w, x, y, z)
    if not length > _SHORTEST:
        raise _no_rotation(kind, numbers)
    return w / length, x / length, y / length, z / length


def _write(kind: Rotation, rotation: _Quaternion, near: Sequence[float]) -> list[float]:
    """Return the numbers of a rotation; of several equal representations, the nearest to `near`."""
    w, x, y, z = rotation
    if kind == "axis_angle":
        return _nearest_vector(_vector(rotation), near)
    if kind == "euler_xyz":
        return _euler(rotation, near)
    if kind == "rot6d":
        return [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y + w * z),
            2.0 * (x * z - w * y),
            2.0 * (x * y - w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z + w * x),
        ]

    numbers = [w, x, y, z] if kind == "quat_wxyz" else [x, y, z, w]
    is_opposite = sum(number * other for number, other in zip(numbers, near, strict=True)) < 0.0
    return [-number for number in numbers] if is_opposite else numbers


def _nearest_vector(vector: list[float], near: Sequence[float]) -> list[float]:
    """Return a rotation vector plus the whole turns with which it is nearest to `near`."""
    angle = math.hypot(*vector)
    # A rotation by no angle may be a whole turn about any axis.
    axis = vector if angle > _SHORTEST else near
    length = math.hypot(*axis)
    if length <= _SHORTEST:
        return vector
    along = sum(number * other for number, other in zip(axis, near, strict=True)) / length
    turned = math.tau * round((along - angle) / math.tau) / length
    return [number + turned * of_axis for number, of_axis in zip(vector, axis, strict=True)]


def _euler(rotation: _Quaternion, near: Sequence[float]) -> list[float]:
    """Return the Euler angles of a rotation that are nearest to other Euler angles."""
    w, x, y, z = rotation
    sine = 2.0 * (w * y - x * z)
    forward = 1.0 - 2.0 * (y * y + z * z)
    sideways = 2.0 * (x * y + w * z)
    cosine = math.hypot(forward, sideways)
    pitch = math.atan2(sine, cosine)

    # With the tool upright, roll and yaw are rotations about the same axis.
    if cosine < _SHORTEST:
        roll = near[0]
        turned = 2.0 * math.atan2(x, w)
        yaw = roll - turned if sine > 0.0 else turned - roll
    else:
        roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        yaw = math.atan2(sideways, forward)

    same_rotation = (
        (roll, pitch, yaw),
        (roll + math.pi, math.pi - pitch, yaw + math.pi),
    )
    nearest: list[float] = []
    least = math.inf
    for angles in same_rotation:
        candidate = []
        for angle, other in zip(angles, near, strict=True):
            candidate.append(angle + math.tau * round((other - angle) / math.tau))
        distance = math.dist(candidate, near)
        if distance < least:
            nearest, least = candidate, distance
    return nearest


def _from_two_axes(numbers: Sequence[float]) -> _Quaternion:
    """Return the rotation whose matrix has two columns, which need not be orthonormal."""
    ax, ay, az, bx, by, bz = numbers
    length = math.hypot(ax, ay, az)
    if not length > _SHORTEST:
        raise _no_rotation("rot6d", numbers)
    ax, ay, az = ax / length, ay / length, az / length

    along = ax * bx + ay * by + az * bz
    bx, by, bz = bx - along * ax, by - along * ay, bz - along * az
    length = math.hypot(bx, by, bz)
    if not length > _SHORTEST:
        raise _no_rotation("rot6d", numbers)
    bx, by, bz = bx / length, by / length, bz / length
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx

    # The largest of the four numbers is computed first, since the others are divided by it.
    w = 1.0 + ax + by + cz
    x = 1.0 + ax - by - cz
    y = 1.0 - ax + by - cz
    z = 1.0 - ax - by + cz
    largest = max(w, x, y, z)
    if largest == w:
        quaternion = (w, bz - cy, cx - az, ay - bx)
    elif largest == x:
        quaternion = (bz - cy, x, ay + bx, cx + az)
    elif largest == y:
        quaternion = (cx - az, ay + bx, y, bz + cy)
    else:
        quaternion = (ay - bx, cx + az, bz + cy, z)
    length = math.hypot(*quaternion)
    w, x, y, z = quaternion
    return w / length, x / length, y / length, z / length


def _no_rotation(kind: str, numbers: Sequence[float]) -> InvalidAction:
    shown = [round(number, 6) for number in numbers]
    return InvalidAction(
        f"action: expected a rotation ({kind}), got {shown}, which has no direction; check the "
        "policy's output, and `rotation` of its contract"
    )


def _product(second: _Quaternion, first: _Quaternion) -> _Quaternion:
    """Return the rotation by `first`, then by `second`, about fixed axes."""
    w, x, y, z = second
    a, b, c, d = first
    return (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )


def _inverse(rotation: _Quaternion) -> _Quaternion:
    w, x, y, z = rotation
    return w, -x, -y, -z


def _vector(rotation: _Quaternion) -> list[float]:
    """Return a rotation as a vector: its axis times its angle, rad, which is at most pi."""
    w, x, y, z = rotation if rotation[0] >= 0.0 else tuple(-number for number in rotation)
    sine = math.hypot(x, y, z)
    if sine == 0.0:
        return [0.0, 0.0, 0.0]
    factor = 2.0 * math.atan2(sine, w) / sine
    return [factor * x, factor * y, factor * z]


def _from_vector(vector: Sequence[float]) -> _Quaternion:
    x, y, z = vector
    angle = math.hypot(x, y, z)
    factor = math.sin(angle / 2) / angle if angle else 0.5
    return math.cos(angle / 2), factor * x, factor * y, factor * z


def _rotated(rotation: _Quaternion, vector: Sequence[float]) -> list[float]:
    """Return a vector, turned by a rotation."""
    x, y, z = vector
    _, *turned = _product(_product(rotation, (0.0, x, y, z)), _inverse(rotation))
    return turned


def _angle(kind: Rotation, numbers: Sequence[float]) -> float:
    """Return the angle of a rotation, rad, at most pi."""
    return math.hypot(*_turn(kind, _IDENTITIES[kind], numbers))


def _turn(kind: Rotation, before: Sequence[float], after: Sequence[float]) -> list[float]:
    """Return the rotation vector, rad, about fixed axes from one rotation to another."""
    if tuple(before) == tuple(after):  # exactly none, without rounding
        return [0.0, 0.0, 0.0]
    return _vector(_product(_read(kind, after), _inverse(_read(kind, before))))


def _between(
    kind: Rotation, start: Sequence[float], goal: Sequence[float], share: float
) -> list[float]:
    """Return the rotation at a share of the shortest way to another rotation."""
    begin = _read(kind, start)
    turn = _turn(kind, start, goal)
    part = _from_vector([share * number for number in turn])
    return _write(kind, _product(part, begin), goal)


def _fraction(rotation: RotationColumns, numbers: Sequence[float], share: float) -> list[float]:
    """Return the fraction of a relative rotation: half a rotation, twice, is the rotation."""
    if rotation.is_linear or rotation.kind == "axis_angle":
        return [share * number for number in numbers]
    identity = _IDENTITIES[rotation.kind]
    turn = _turn(rotation.kind, identity, numbers)
    near = []
    for number, none in zip(numbers, identity, strict=True):
        near.append(none + share * (number - none))
    return _write(rotation.kind, _from_vector([share * number for number in turn]), near)


def _mean(rotations: Sequence[_Quaternion], weights: np.ndarray) -> _Quaternion:
    """Return the mean of rotations with the least weighted sum of squared distances of their
    matrices (Markley et al. 2007, https://doi.org/10.2514/1.28949).
    """
    quaternions = np.array(rotations)
    _, vectors = np.linalg.eigh((quaternions.T * weights) @ quaternions)
    w, x, y, z = vectors[:, -1].tolist()
    return w, x, y, z


def _padded(vector: list[float], width: int) -> list[float]:
    return vector + [0.0] * (width - len(vector))
