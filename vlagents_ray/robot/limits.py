"""The limits of a robot's motion: from its own file, from a dataset of demonstrations, or from a
URDF.
"""

from __future__ import annotations

import itertools
import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec
from vlagents_ray.dataset_contract import INFO, DatasetContract
from vlagents_ray.datasets.episode import TICK_COLUMN
from vlagents_ray.errors import ConfigError
from vlagents_ray.naming import did_you_mean, without_duplicate_keys
from vlagents_ray.registry import require
from vlagents_ray.yaml_text import load_yaml

# One limit for all numbers of an action, or one for each number.
Numbers = float | tuple[float, ...]
# Limits from a dataset are based on this quantile of the demonstrations' speeds, since a single
# broken frame must not set a limit.
QUANTILE = 0.999
MARGIN = 2.0
"""The ratio of the limits to the quantiles of a dataset. The soft start begins at half of the
limits, i.e. at the quantiles.
"""
_ACCEPTED = "a .yaml or .json file of limits, a .urdf, or the folder of a LeRobotDataset v3.0"
_PER_RAD = {"rad": 1.0, "deg": 180 / math.pi}
_TOLERANCE = 0.1  # share of the demonstrated range by which an action may exceed the range


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """The limits of the actions, (D,) in their units and order; None checks nothing.

    Raises:
        ConfigError: A number is NaN or otherwise invalid, or a field has no effect because another
            field is not set.
    """

    low: Numbers | None = None
    high: Numbers | None = None
    velocity: Numbers | None = None  # units/s
    acceleration: Numbers | None = None  # units/s^2; a robot may always brake
    jerk: Numbers | None = None  # units/s^3; a robot may always brake
    first: Numbers | None = None
    """The largest distance of the first action from the pose at rest; default: the distance of
    0.5 s at `velocity`.
    """
    rest: tuple[float | None, ...] | None = None
    """The pose to which the arm moves slowly at the end of a run. A number that is None keeps its
    last command; the numbers of grippers must be None.
    """
    joints: tuple[str, ...] = ()  # the names of the action's numbers, in order
    unit: str = "rad"  # the unit of the joints: "rad" or "deg"
    # The bounds of the tip's position in the base frame of the URDF, m.
    workspace_low: tuple[float, float, float] | None = None
    workspace_high: tuple[float, float, float] | None = None
    chain: Chain | None = None  # forward kinematics from the joints to the tip

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            _numbers(name, getattr(self, name))
        for name in ("velocity", "acceleration", "jerk", "first"):
            value = getattr(self, name)
            if (_numbers(name, value) < 0).any():
                raise ConfigError(f"{name}: expected numbers of 0 or more, got {value}")
        for name in ("workspace_low", "workspace_high"):
            value = getattr(self, name)
            if _numbers(name, value).shape != (3,) and value is not None:
                raise ConfigError(f"{name}: expected x, y and z in m, got {value}")

        rest_numbers = [number for number in self.rest or () if number is not None]
        if not np.isfinite(_numbers("rest", rest_numbers)).all():
            raise ConfigError(f"rest: expected finite numbers or null, got {self.rest}")
        if self.unit not in _PER_RAD:
            raise ConfigError(f"unit: expected 'rad' or 'deg', got {self.unit!r}")

    @classmethod
    def read(cls, path: str | Path, action: ActionSpec | None = None) -> MotionLimits:
        """Read limits from a `.yaml` or `.json` file, a `.urdf` file, or the folder of a
        LeRobotDataset v3.0.

        The keys of a YAML or JSON file are the fields of this class without `chain`. Two further
        keys are `urdf`, the path of a URDF relative to the file, whose limits also apply, and
        `tip`, the link whose position the workspace limits.

        Args:
            path: The file or folder.
            action: The description of the actions, for a dataset without one; default: absolute
                targets.

        Returns:
            The limits. Limits from a dataset allow somewhat larger motions than its demonstrations.

        Raises:
            ConfigError: The file is missing, or has an unknown key or a wrong value.
            MissingDependency: The extra "limits" (for YAML) or "record" (for a dataset) is not
                installed.
        """
        path = Path(path)
        try:
            if path.is_dir():
                return cls._from_dataset(path, action)
            if path.suffix == ".urdf":
                return cls._from_urdf(path, joints=(), tip=None, scale=1.0)
            return cls._from_document(path, _document(path))
        except ConfigError as error:
            raise ConfigError(f"limits {path}: {error}") from error
        except FileNotFoundError as error:
            raise ConfigError(
                f"limits {path}: expected {_ACCEPTED}, got no file {error.filename}; see "
                "docs/guard.md"
            ) from error
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            RecursionError,
            ET.ParseError,
        ) as error:
            raise ConfigError(
                f"limits {path}: expected {_ACCEPTED}, got {type(error).__name__}: {error}; see "
                "docs/guard.md"
            ) from error

    @classmethod
    def _from_document(cls, path: Path, document: Any) -> MotionLimits:
        """Return the limits in the content of a YAML or JSON file."""
        urdf = document.pop("urdf", None)
        tip = document.pop("tip", None)
        known_keys = {field.name for field in fields(cls)} - {"chain"} | {"urdf", "tip"}
        unknown = sorted(set(document) - known_keys)
        if unknown:
            suggestions = "".join(did_you_mean(str(key), known_keys) for key in unknown)
            raise ConfigError(f"expected only {sorted(known_keys)}, got {unknown}{suggestions}")
        if not isinstance(document.get("joints", []), list):
            raise ConfigError(f"joints: expected a list of names, got {document['joints']!r}")

        limits = cls(**{key: _value(key, value) for key, value in document.items()})
        bounds_workspace = limits.workspace_low is not None or limits.workspace_high is not None
        if bounds_workspace != (tip is not None) or (tip is not None and urdf is None):
            raise ConfigError(
                "tip, urdf and workspace: expected `tip` and `urdf` with `workspace_low` or "
                "`workspace_high`, as each has no effect without the others; add the missing keys, "
                "or remove these keys"
            )

        if urdf is None:
            if "unit" in document:
                raise ConfigError(
                    "unit: expected `urdf` next to `unit`, which converts the numbers of the URDF, "
                    "got none; remove `unit`, as limits are in the units of the actions"
                )
            return limits

        urdf_limits = cls._from_urdf(
            path.parent / urdf, joints=limits.joints, tip=tip, scale=_PER_RAD[limits.unit]
        )
        return limits.stricter(urdf_limits)

    def bounds(self, dim: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest positions, (dim,) each.

        A bound is infinite if it is not set, or if the number of its values is not `dim`.
        """

        def bound(limit: Numbers | None, unlimited: float) -> np.ndarray:
            """Return a limit for each number of an action, (dim,)."""
            is_set = limit is not None and np.shape(limit) in ((), (dim,))
            return np.broadcast_to(np.asarray(limit if is_set else unlimited), dim)

        return bound(self.low, -np.inf), bound(self.high, np.inf)

    def stricter(self, other: MotionLimits) -> MotionLimits:
        """Return the stricter of this object and other limits, for each number. The rest pose,
        workspace, unit and distance of the first action are this object's.

        Raises:
            ConfigError: A value has different numbers of columns in the two limits.
        """

        def stricter_of(name: str) -> Numbers | None:
            """Return the stricter of the two values of a field."""
            ours, theirs = getattr(self, name), getattr(other, name)
            if ours is None or theirs is None:
                return theirs if ours is None else ours  # type: ignore[no-any-return]
            if np.size(ours) != np.size(theirs) and 1 not in (np.size(ours), np.size(theirs)):
                raise ConfigError(
                    f"{name}: expected as many numbers as in the other limits, {np.size(theirs)}, "
                    f"got {np.size(ours)}; give both limits for the same arm, or one number for "
                    "all columns"
                )
            choose = np.maximum if name == "low" else np.minimum
            return tuple(choose(*np.broadcast_arrays(ours, theirs)).ravel().tolist())

        names = ("low", "high", "velocity", "acceleration", "jerk")
        bounds = {name: stricter_of(name) for name in names}
        chain = self.chain or other.chain
        joints = self.joints or other.joints
        return replace(self, chain=chain, joints=joints, **bounds)  # type: ignore[arg-type]

    @classmethod
    def _from_dataset(cls, folder: Path, action: ActionSpec | None) -> MotionLimits:
        """Return limits that allow the motions of a LeRobotDataset."""
        info = json.loads((folder / "meta/info.json").read_text())
        if INFO in info:
            action = DatasetContract.from_json(info[INFO]).contract.action

        fps = float(info["fps"])
        sections = _dataset_sections(folder)
        if not sections:
            raise ConfigError("expected at least one frame in data/, got none")

        actions = np.concatenate([section.actions for section in sections])
        columns = Columns.from_spec(action or ActionSpec(), actions.shape[1])
        motions = [_motions(section, columns) for section in sections]

        def fastest(order: int) -> tuple[float, ...]:
            """Return a limit of the speed (order 1) or of its changes, in units and seconds."""
            changes = [_sizes(np.diff(speeds, order - 1, axis=0), columns) for speeds in motions]
            frames = np.concatenate(changes)
            if not len(frames):
                raise ConfigError(
                    f"expected {order + 1} frames at consecutive ticks, got at most "
                    f"{1 + max(map(len, motions))}; the recorder dropped the frames between (see "
                    "the column `tick`): record again, at a lower rate or with smaller images"
                )

            limit: np.ndarray = np.quantile(frames, QUANTILE, axis=0)
            # A motion of deltas begins at rest. The frames at its beginning are too few to affect
            # the quantile of all frames, so they have their own quantile.
            starts = []
            for section, section_changes in zip(sections, changes, strict=True):
                if columns.relative and section.begins_episode:
                    starts.append(section_changes[:order].max(0))
            if starts:
                start_limit = np.quantile(np.stack(starts), QUANTILE, axis=0, method="higher")
                limit = np.maximum(limit, start_limit)
            limit *= MARGIN * fps**order
            # A gripper that rarely moves has the quantile 0, but a limit of 0 would never let it
            # move.
            return tuple(number if number > 0 else math.inf for number in limit.tolist())

        tolerance = _TOLERANCE * np.ptp(actions, axis=0)
        low = actions.min(0) - tolerance
        high = actions.max(0) + tolerance
        unbounded = list(columns.relative)  # motions are limited by `velocity`
        for rotation in columns.rotations:
            unbounded += rotation.columns  # several numbers represent the same rotation
        low[unbounded] = -np.inf
        high[unbounded] = np.inf
        names = info["features"]["action"].get("names")
        return cls(
            low=tuple(low.tolist()),
            high=tuple(high.tolist()),
            velocity=fastest(1),
            acceleration=fastest(2),
            jerk=fastest(3),
            joints=tuple(names) if isinstance(names, list) else (),
        )

    @classmethod
    def _from_urdf(
        cls, file: Path, *, joints: Sequence[str], tip: str | None, scale: float
    ) -> MotionLimits:
        """Return the limits of positions and speeds of a URDF.

        Args:
            file: The file.
            joints: The joints that belong to the numbers of an action, in order; empty for all
                movable joints.
            tip: The link whose position the workspace limits.
            scale: The factor from rad to the units of the actions.
        """
        robot = ET.parse(file).getroot()  # noqa: S314 - the file belongs to the robot's owner
        elements = {}
        for joint in robot.iter("joint"):
            if joint.find("child") is not None:
                elements[joint.attrib["name"]] = joint

        moving = [name for name, joint in elements.items() if joint.attrib["type"] != "fixed"]
        names = list(joints) or moving
        unknown = sorted(set(names) - set(elements))
        if unknown:
            raise ConfigError(
                f"{file}: expected the joints {sorted(elements)}, got {unknown}; name them in "
                "`joints`"
            )

        def limit_of(name: str, key: str, default: float) -> float:
            """Return the limit of a joint in the units of the actions."""
            joint = elements[name]
            joint_type = joint.attrib["type"]
            unit = 1.0 if joint_type == "prismatic" else scale

            limit = joint.find("limit")
            is_limited = key == "velocity" or joint_type != "continuous"
            value = default
            if limit is not None and is_limited:
                value = float(limit.attrib.get(key, default))
            if key == "velocity":
                value = value or default  # URDFs write 0 for an unknown speed
            return value * unit

        return cls(
            low=tuple(limit_of(name, "lower", -math.inf) for name in names),
            high=tuple(limit_of(name, "upper", math.inf) for name in names),
            velocity=tuple(limit_of(name, "velocity", math.inf) for name in names),
            joints=tuple(names),
            chain=None if tip is None else Chain(elements, tip, names, 1.0 / scale),
        )


class _Joint(NamedTuple):
    """A joint of a kinematic chain."""

    rotation: list[float]  # rotation from the child's frame to the parent's frame, (9,), row by row
    offset: list[float]  # offset of the child's frame in the parent's frame, (3,), m
    axis: list[float]  # axis of the joint, unit vector, (3,)
    action_index: int  # index of the joint's number in an action; -1 if it has none
    slides: bool


class Chain:
    """The forward kinematics from joints to the position of a link, computed with plain floats,
    since numpy is slower for one point.

    Args:
        joints: The elements of the URDF's joints, by name.
        tip: The link at the end of the chain.
        names: The joints that belong to the numbers of an action, in order.
        to_rad: The factor from the units of the actions to rad.

    Raises:
        ConfigError: The URDF has no such link.
    """

    def __init__(
        self, joints: Mapping[str, Any], tip: str, names: Sequence[str], to_rad: float
    ) -> None:
        joint_of_child = {}
        for name, joint in joints.items():
            joint_of_child[joint.find("child").attrib["link"]] = (name, joint)
        if tip not in joint_of_child:
            raise ConfigError(f"tip: expected a link, one of {sorted(joint_of_child)}, got {tip!r}")

        self._to_rad = to_rad
        self._joints: list[_Joint] = []  # from the tip to the base
        link = tip
        while link in joint_of_child:
            name, joint = joint_of_child[link]
            joint_type = joint.attrib["type"]
            origin = joint.find("origin")
            attributes = {} if origin is None else origin.attrib
            rotation = _rotation(*_three(attributes.get("rpy", "0 0 0")))

            axis = joint.find("axis")
            direction = np.array([1.0, 0.0, 0.0] if axis is None else _three(axis.attrib["xyz"]))
            direction /= np.linalg.norm(direction) or 1.0

            is_moved = name in names and joint_type != "fixed"
            self._joints.append(
                _Joint(
                    rotation=rotation.ravel().tolist(),
                    offset=_three(attributes.get("xyz", "0 0 0")),
                    axis=direction.tolist(),
                    action_index=names.index(name) if is_moved else -1,
                    slides=joint_type == "prismatic",
                )
            )
            link = joint.find("parent").attrib["link"]

    def tip(self, joints: Sequence[float]) -> tuple[float, float, float]:
        """Return the position of the tip in the base frame, m, for an absolute action."""
        x = y = z = 0.0
        for rotation, (ox, oy, oz), (ax, ay, az), index, slides in self._joints:
            if index >= 0 and slides:
                x, y, z = x + joints[index] * ax, y + joints[index] * ay, z + joints[index] * az
            elif index >= 0:  # Rodrigues' formula
                angle = joints[index] * self._to_rad
                cos, sin = math.cos(angle), math.sin(angle)
                along = (ax * x + ay * y + az * z) * (1.0 - cos)
                x, y, z = (
                    x * cos + (ay * z - az * y) * sin + ax * along,
                    y * cos + (az * x - ax * z) * sin + ay * along,
                    z * cos + (ax * y - ay * x) * sin + az * along,
                )

            xx, xy, xz, yx, yy, yz, zx, zy, zz = rotation
            x, y, z = (
                xx * x + xy * y + xz * z + ox,
                yx * x + yy * y + yz * z + oy,
                zx * x + zy * y + zz * z + oz,
            )
        return x, y, z


def _rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the matrix of a URDF's fixed angles, (3, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _three(text: str) -> list[float]:
    """Return the three numbers of an attribute."""
    x, y, z = map(float, text.split())
    return [x, y, z]


class _Section(NamedTuple):
    """Actions of an episode at consecutive ticks.

    A tick without a frame ends a section: the frame was dropped, or the robot was paused. The
    action of that tick is unknown, so the actions around it do not contain the speed.
    """

    actions: np.ndarray  # (T, D)
    begins_episode: bool  # whether the first action is the episode's first, which begins at rest


def _motions(section: _Section, columns: Columns) -> np.ndarray:
    """Return the motion of each tick of a section, in units per tick; see `Columns.motion`.

    Args:
        section: The section, with T actions of D numbers.
        columns: The meaning of the numbers.

    Returns:
        The motions of all actions but the first, (T - 1, D). At the beginning of an episode of
        relative actions, those of three ticks at rest and of the first action are before them.
    """
    rows = section.actions
    if columns.relative and section.begins_episode:
        rest = columns.still(rows[0]).astype(np.float64)
        rows = np.concatenate([[rest] * 3, rows])
    if columns.rotations:
        motions = []
        for last, row in itertools.pairwise(rows.tolist()):
            motions.append(columns.motion(row, last))
        return np.array(motions, np.float64).reshape(-1, columns.dim)

    speeds = np.diff(rows, axis=0)
    relative = list(columns.relative)
    speeds[:, relative] = rows[1:, relative]
    return speeds


def _sizes(changes: np.ndarray, columns: Columns) -> np.ndarray:
    """Return the sizes of motions or their changes, (T, D). The size of a rotation is an angle, in
    each of its columns.
    """
    sizes: np.ndarray = np.abs(changes)
    for rotation in columns.rotations:
        part = slice(rotation.start, rotation.stop)
        sizes[:, part] = np.linalg.norm(changes[:, part], axis=1, keepdims=True)
    return sizes


def _numbers(name: str, value: object) -> np.ndarray:
    """Return the numbers of a limit, which is one number, a list of numbers, or None.

    Raises:
        ConfigError: The value has another type, or is NaN.
    """
    if value is None:
        return np.array([], np.float64)

    values = value if isinstance(value, (tuple, list, np.ndarray)) else [value]
    for number in values:
        if (
            isinstance(number, bool)
            or not isinstance(number, (int, float, np.number))
            or math.isnan(number)
        ):
            raise ConfigError(f"{name}: expected numbers, got {number!r} in {value}")
    return np.array(values, np.float64)


def _value(key: str, value: Any) -> Any:
    """Return the value of a key of a file. Null, which means no limit, becomes infinity, except in
    `rest`.
    """
    if not isinstance(value, list):
        return value
    unlimited = -math.inf if key in ("low", "workspace_low") else math.inf
    return tuple(unlimited if number is None and key != "rest" else number for number in value)


def _dataset_sections(folder: Path) -> list[_Section]:
    """Return the sections of all episodes of a LeRobotDataset, in their order.

    A dataset without the column `tick`, such as one that LeRobot recorded, has no gaps.
    """
    parquet = require("pyarrow.parquet", extra="record")
    rows_of_episodes: dict[int, list[np.ndarray]] = {}
    ticks_of_episodes: dict[int, list[np.ndarray]] = {}
    for file in sorted(folder.glob("data/*/*.parquet")):
        available = parquet.read_schema(file).names
        columns = [name for name in ("action", "episode_index", TICK_COLUMN) if name in available]
        table = parquet.read_table(file, columns=columns)
        rows = np.array(table["action"].to_pylist(), np.float64)
        rows = rows.reshape(len(rows), -1)  # LeRobot stores an action of one number as a scalar
        ticks = table[TICK_COLUMN].to_numpy() if TICK_COLUMN in available else np.arange(len(rows))
        episodes = table["episode_index"].to_numpy()
        for episode in np.unique(episodes):
            is_of_episode = episodes == episode
            rows_of_episodes.setdefault(int(episode), []).append(rows[is_of_episode])
            ticks_of_episodes.setdefault(int(episode), []).append(ticks[is_of_episode])

    sections = []
    for episode, rows_of_files in rows_of_episodes.items():
        ticks = np.concatenate(ticks_of_episodes[episode])
        gaps = np.flatnonzero(np.diff(ticks) != 1) + 1
        for number, actions in enumerate(np.split(np.concatenate(rows_of_files), gaps)):
            sections.append(_Section(actions, begins_episode=number == 0))
    return sections


def _document(path: Path) -> Any:
    """Return the content of a YAML or JSON file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".json":
        return json.loads(text, object_pairs_hook=without_duplicate_keys)
    return load_yaml(text, extra="limits")
