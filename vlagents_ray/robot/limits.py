"""The limits of a robot's motion: from its own file, from a dataset of demonstrations, or from a URDF."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.naming import did_you_mean, without_doubles
from vlagents_ray.registry import require
from vlagents_ray.yaml_text import load_yaml

Numbers = float | tuple[float, ...]  # one for all numbers of an action, or one for each
QUANTILE = 0.999  # of the demonstrations' speeds: a single broken frame must not set a limit
MARGIN = 2.0
"""Limits from a dataset are its quantiles times this. The soft start begins at half of them, i.e. at the quantiles."""
_ROOM = 0.1  # share of the demonstrated range by which an action may leave it


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of the actions, (D,) in their units and order; None checks nothing."""

    low: Numbers | None = None
    high: Numbers | None = None
    velocity: Numbers | None = None  # units/s
    acceleration: Numbers | None = None  # units/s^2, of speeding up; a robot may always brake
    jerk: Numbers | None = None  # units/s^3, likewise
    first: Numbers | None = None
    """The largest distance of the first action from the pose at rest; default: that of 0.5 s at `velocity`."""
    rest: tuple[float, ...] | None = None  # pose to which the arm goes slowly at the end of a run
    joints: tuple[str, ...] = ()  # the names of the action's numbers, in order
    unit: str = "rad"  # "rad" or "deg", of the joints
    workspace_low: tuple[float, float, float] | None = None  # m, of the tip in the base frame of the URDF
    workspace_high: tuple[float, float, float] | None = None
    chain: Chain | None = None  # from joints to the tip

    @classmethod
    def read(cls, path: str | Path) -> Limits:
        """Read limits from a `.yaml` or `.json` file, a `.urdf` file, or the folder of a LeRobotDataset v3.0.

        The keys of a YAML or JSON file are the fields of this class, without `chain`, and further `urdf`, a file beside
        it whose limits also apply, and `tip`, the link that the workspace is for.

        Raises:
            ConfigError: The file is missing, or has an unknown key or a wrong value.
            MissingDependency: YAML needs the extra "limits", a dataset "record".
        """
        path = Path(path)
        try:
            if path.is_dir():
                return cls._of_dataset(path)
            if path.suffix == ".urdf":
                return cls._of_urdf(path, (), None, 1.0)
            given = _document(path)
            urdf, tip = given.pop("urdf", None), given.pop("tip", None)
            known = {one.name for one in fields(cls)} - {"chain"} | {"urdf", "tip"}
            if unknown := sorted(set(given) - known):
                meant = "".join(did_you_mean(str(key), known) for key in unknown)
                raise ConfigError(f"{path}: unknown keys {unknown}, want some of {sorted(known)}{meant}")
            values = {key: _tuple(value, -math.inf if key == "low" else math.inf) for key, value in given.items()}
            limits = cls(**values)
            if (scale := {"rad": 1.0, "deg": 180 / math.pi}.get(limits.unit)) is None:
                raise ConfigError(f"{path}: unit: got {limits.unit!r}, want 'rad' or 'deg'")
            for key in ("low", "high", "velocity", "acceleration", "jerk", "first", "rest"):
                np.asarray(getattr(limits, key) or 0.0, np.float64)
            if urdf is None:
                return limits
            return limits.stricter(cls._of_urdf(path.parent / urdf, limits.joints, tip, scale))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, ET.ParseError) as error:
            raise ConfigError(
                f"limits {path}: {type(error).__name__}: {error}; want a .yaml or .json file of limits, a .urdf, or a "
                f"LeRobotDataset v3.0; see docs/control_loop.md"
            ) from error

    def bounds(self, dim: int) -> tuple[np.ndarray, np.ndarray]:
        """Return `low` and `high`, (dim,) each; infinite where none is set, and for another number of joints."""
        ends, fitting = ((self.low, -np.inf), (self.high, np.inf)), ((), (dim,))
        low, high = (
            np.broadcast_to(one if one is not None and np.shape(one) in fitting else free, dim) for one, free in ends
        )
        return low, high

    def stricter(self, other: Limits) -> Limits:
        """Return these limits, each replaced by the other's where that is stricter."""

        def least(name: str) -> Numbers | None:
            a, b = getattr(self, name), getattr(other, name)
            if a is None or b is None:
                return b if a is None else a  # type: ignore[no-any-return]
            return tuple((np.maximum if name == "low" else np.minimum)(*np.broadcast_arrays(a, b)).ravel().tolist())

        bounds = {name: least(name) for name in ("low", "high", "velocity", "acceleration", "jerk")}
        return replace(self, chain=self.chain or other.chain, joints=self.joints or other.joints, **bounds)  # type: ignore[arg-type]

    @classmethod
    def _of_dataset(cls, folder: Path) -> Limits:
        info = json.loads((folder / "meta/info.json").read_text())
        parquet, fps = require("pyarrow.parquet", extra="record"), float(info["fps"])
        episodes: dict[int, list[np.ndarray]] = {}
        for file in sorted(folder.glob("data/*/*.parquet")):
            table = parquet.read_table(file, columns=["action", "episode_index"])
            rows = np.array(table["action"].to_pylist(), np.float64)
            numbers = table["episode_index"].to_numpy()
            for one in np.unique(numbers):
                episodes.setdefault(int(one), []).append(rows[numbers == one])
        whole = [np.concatenate(parts) for parts in episodes.values()]
        actions = np.concatenate(whole)
        room = _ROOM * np.ptp(actions, axis=0)
        names = info["features"]["action"].get("names")

        def fastest(order: int) -> tuple[float, ...]:
            changes = np.concatenate([np.abs(np.diff(one, order, axis=0)) for one in whole if len(one) > order])
            limit = np.quantile(changes, QUANTILE, axis=0) * MARGIN * fps**order
            # A gripper that hardly ever moves has the quantile 0, by which it could never be moved.
            return tuple(np.where(limit > 0, limit, np.inf).tolist())

        return cls(
            low=tuple((actions.min(0) - room).tolist()),
            high=tuple((actions.max(0) + room).tolist()),
            velocity=fastest(1),
            acceleration=fastest(2),
            jerk=fastest(3),
            joints=tuple(names) if isinstance(names, list) else (),
        )

    @classmethod
    def _of_urdf(cls, file: Path, joints: Sequence[str], tip: str | None, scale: float) -> Limits:
        robot = ET.parse(file).getroot()  # noqa: S314 - a file of this robot's owner
        elements = {one.attrib["name"]: one for one in robot.iter("joint") if one.find("child") is not None}
        names = [*joints] or [name for name, one in elements.items() if one.attrib["type"] != "fixed"]
        if unknown := sorted(set(names) - set(elements)):
            raise ConfigError(f"{file}: has no joints {unknown}, has {sorted(elements)}; name them in `joints`")

        def stated(name: str, key: str, default: float) -> float:
            joint = elements[name]
            limit, unit = joint.find("limit"), 1.0 if joint.attrib["type"] == "prismatic" else scale
            bounded = limit is not None and (key == "velocity" or joint.attrib["type"] != "continuous")
            value = float(limit.attrib.get(key, default)) if limit is not None and bounded else default
            return (value or default) * unit if key == "velocity" else value * unit

        return cls(
            low=tuple(stated(name, "lower", -math.inf) for name in names),
            high=tuple(stated(name, "upper", math.inf) for name in names),
            velocity=tuple(stated(name, "velocity", math.inf) for name in names),
            joints=tuple(names),
            chain=None if tip is None else Chain(elements, tip, names, 1.0 / scale),
        )


class Chain:
    """The forward kinematics from joints to the position of a link, in plain floats: numpy is slower for one point."""

    def __init__(self, joints: Mapping[str, Any], tip: str, names: Sequence[str], to_rad: float) -> None:
        """Read the joints from the base to the link `tip`; `names` are those of an action's numbers, in order."""
        parents = {one.find("child").attrib["link"]: (name, one) for name, one in joints.items()}
        if tip not in parents:
            raise ConfigError(f"tip: got {tip!r}, want one of the links {sorted(parents)}")
        self._links: list[tuple[list[float], list[float], list[float], int, bool]] = []  # from the tip to the base
        self._to_rad = to_rad
        while tip in parents:
            name, one = parents[tip]
            origin, axis, kind = one.find("origin"), one.find("axis"), one.attrib["type"]
            attributes = {} if origin is None else origin.attrib
            direction = np.array([1.0, 0.0, 0.0] if axis is None else _three(axis.attrib["xyz"]))
            direction /= np.linalg.norm(direction) or 1.0
            turn = _rotation(*_three(attributes.get("rpy", "0 0 0"))).ravel().tolist()
            place = names.index(name) if name in names and kind != "fixed" else -1
            offset = _three(attributes.get("xyz", "0 0 0"))
            self._links.append((turn, offset, direction.tolist(), place, kind == "prismatic"))
            tip = one.find("parent").attrib["link"]

    def tip(self, joints: Sequence[float]) -> tuple[float, float, float]:
        """Return the position of the tip in the base frame, m, at the numbers of an action."""
        x = y = z = 0.0
        for turn, (ox, oy, oz), (ax, ay, az), place, slides in self._links:
            if place >= 0 and slides:
                x, y, z = x + joints[place] * ax, y + joints[place] * ay, z + joints[place] * az
            elif place >= 0:  # Rodrigues' formula
                angle = joints[place] * self._to_rad
                c, s = math.cos(angle), math.sin(angle)
                along = (ax * x + ay * y + az * z) * (1.0 - c)
                x, y, z = (
                    x * c + (ay * z - az * y) * s + ax * along,
                    y * c + (az * x - ax * z) * s + ay * along,
                    z * c + (ax * y - ay * x) * s + az * along,
                )
            a, b, c, d, e, f, g, h, i = turn
            x, y, z = a * x + b * y + c * z + ox, d * x + e * y + f * z + oy, g * x + h * y + i * z + oz
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
    x, y, z = map(float, text.split())
    return [x, y, z]


def _tuple(value: Any, unlimited: float) -> Any:
    return tuple(unlimited if one is None else one for one in value) if isinstance(value, list) else value


def _document(path: Path) -> Any:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".json":
        return json.loads(text, object_pairs_hook=without_doubles)
    return load_yaml(text, extra="limits")
