"""The contract of a dataset of demonstrations, and its transfer into checkpoints trained on the
dataset.

LeRobot copies nothing of a dataset's `info.json` into a checkpoint, but all of its `stats.json`,
with which a policy normalises. So the contract is written to `info.json` for readers and also to
`stats.json`, as a feature whose values are the bytes of the contract's JSON. Every version of
LeRobot copies this feature into the checkpoint.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, MalformedMessage

INFO = "vlagents_ray"  # key in `info.json`
TRACE = "trace"  # key in the `info.json` of a server's recordings
CHUNK, ROWS, SESSION = "chunk", "chunk_rows", "session"  # columns of a recording
STATISTICS, BYTES = "vlagents_ray_contract", "mean"  # keys in `stats.json`
GRIPPER = "gripper"  # name of the state part that stands for `Obs.gripper`
_JOINTS = "joints"  # name of `observation.state` if its parts are unknown
Centre = float | tuple[float, float, float]  # centre of an angle, or of a rotation vector, rad
_TURN = 2 * math.pi
_USUAL = {"joints": "rad", "xyzrpy": "m+rad"}
_SLACK = 1e-3  # rad: float32 angles may slightly exceed pi


@dataclass(frozen=True, slots=True)
class DatasetContract:
    """The meaning of the numbers and images of a dataset."""

    contract: Contract  # contract of a policy that is trained on the dataset
    # The concatenated parts of `observation.state`; "gripper" is `Obs.gripper`.
    state: tuple[str, ...] = ()
    cameras: Mapping[str, str] = field(default_factory=dict)  # feature -> camera
    # The centre of each angle or rotation vector, rad, by its first index in `observation.state`.
    angles: Mapping[int, Centre] = field(default_factory=dict)
    environment: tuple[str, ...] = ()  # the parts of `observation.environment_state`

    @property
    def width(self) -> int:
        """The number of values in `observation.state`; parts of unknown width count as zero."""
        specs = self.contract.state or {}
        return sum((specs[name].dim or 0) if name in specs else 1 for name in self.state)

    def wrapped(self, state: np.ndarray) -> np.ndarray:
        """Return `observation.state`, (..., D) float32, with each of `angles` within pi of its
        centre.

        A robot's angle jumps by a full turn between -pi and pi, and so does the angle of a rotation
        vector; a wrapped angle jumps where the demonstrations have no values.
        """
        if not self.angles:
            return state
        wrapped = state.copy()
        for index, centre in self.angles.items():
            if isinstance(centre, tuple):
                columns = slice(index, index + 3)
                vectors = state[..., columns].astype(np.float64)
                wrapped[..., columns] = _near_vector(vectors, np.array(centre))
            else:
                wrapped[..., index] = _near(state[..., index].astype(np.float64), centre)
        return wrapped

    def to_json(self) -> dict[str, Any]:
        """Return the contract as plain JSON values."""
        angles = {}
        for index, centre in self.angles.items():
            angles[str(index)] = list(centre) if isinstance(centre, tuple) else centre
        return {
            "state": list(self.state),
            "environment": list(self.environment),
            "cameras": dict(self.cameras),
            "angles": angles,
            "contract": self.contract.to_json(),
        }

    @classmethod
    def from_json(cls, data: Any) -> DatasetContract:
        """Read a contract from the result of `to_json`; raises `ConfigError` if this version
        cannot read it.
        """
        try:
            contract = cls(
                Contract.from_json(data["contract"]),
                tuple(map(str, data["state"])),
                {str(key): str(name) for key, name in data["cameras"].items()},
                {int(index): _centre(centre) for index, centre in data["angles"].items()},
                tuple(map(str, data["environment"])),
            )
            contract._check()
        except (MalformedMessage, AttributeError, KeyError, TypeError, ValueError) as error:
            raise ConfigError(
                "the contract of the dataset in the checkpoint cannot be read "
                f"({type(error).__name__}: {error}); was the dataset written by a newer "
                "vlagents-ray, or merged from datasets with different contracts? Update "
                "vlagents-ray, or export the results of `vlagents-ray merge`"
            ) from error
        return contract

    def _check(self) -> None:
        """Raise `ValueError` if a part or an angle is not in the state."""
        known = {*(self.contract.state or {}), GRIPPER}
        unknown = {*self.state, *self.environment} - known
        if unknown:
            raise ValueError(f"its contract has no state {sorted(unknown)}")

        invalid = []
        for index, centre in self.angles.items():
            numbers = np.atleast_1d(centre)
            if not 0 <= index <= self.width - len(numbers) or np.isnan(numbers).any():
                invalid.append(index)
        if invalid:
            raise ValueError(f"its state has no angles at {invalid}")

    def to_statistics(self, frames: int) -> dict[str, dict[str, list[int]]]:
        """Return the entry of `stats.json` with the contract, for a dataset of `frames` frames.

        The entry has all statistics of a usual feature, since LeRobot's tools average these when
        they merge datasets.
        """
        text = json.dumps(self.to_json(), separators=(",", ":"), ensure_ascii=False)
        numbers = list(text.encode())
        names = ("min", "max", BYTES, "q01", "q10", "q50", "q90", "q99")
        statistics = dict.fromkeys(names, numbers)
        return {STATISTICS: statistics | {"std": [0] * len(numbers), "count": [frames]}}

    @classmethod
    def from_statistics(cls, numbers: Iterable[float]) -> DatasetContract:
        """Read a contract from the numbers that `to_statistics` returned and LeRobot stored; raises
        `ConfigError` if they are invalid.
        """
        try:
            data = json.loads(bytes(round(number) for number in numbers))
        except ValueError as error:
            data = str(error)
        return cls.from_json(data)


def state_parts(
    width: int, policy: Contract | None, chosen: Sequence[str] | None = None, *, option: str
) -> list[tuple[str, int]]:
    """Divide `observation.state` of a dataset, or of a robot with LeRobot's names, into parts for a
    policy.

    Args:
        width: The number of values in `observation.state`.
        policy: The policy's contract, with the sizes of its parts.
        chosen: The parts in their order, "gripper" for `Obs.gripper`; by default the parts of the
            contract, or else `joints`.
        option: The option that sets `chosen`, with an example, for the error message.

    Returns:
        The parts in their order, each with its size.

    Raises:
        ConfigError: The sizes of the parts are unknown, or do not add up to `width`.
    """
    specs = dict((policy and policy.state) or {})
    names = list(chosen if chosen is not None else wanted_parts(policy) or [_JOINTS])

    dims: dict[str, int | None] = {}
    for name in names:
        if name == GRIPPER:
            dims[name] = 1
        else:
            dims[name] = specs[name].dim if name in specs else None

    # If a single part has an unknown size, its size is the number of remaining values, at least
    # one.
    unknown = [name for name, dim in dims.items() if dim is None]
    remaining = width - sum(dim or 0 for dim in dims.values())
    if len(unknown) == 1:
        dims[unknown[0]] = remaining
        is_divided = remaining >= 1
    else:
        is_divided = not unknown and remaining == 0
    if not is_divided:
        raise ConfigError(
            f"observation.state: expected {names} of the policy, with the sizes {dims}, got "
            f"{width} numbers without a division; name the parts in their order: {option}"
        )
    return [(name, dim or 0) for name, dim in dims.items()]


def wanted_parts(policy: Contract | None) -> list[str]:
    """Return the parts of the state that a policy's contract names, followed by "gripper" if the
    policy needs `Obs.gripper`.
    """
    if policy is None:
        return []
    names = list(policy.state or {})
    if policy.gripper:
        names.append(GRIPPER)
    return names


def divided_state(
    vectors: Mapping[str, np.ndarray], parts: Mapping[str, Sequence[tuple[str, int]]]
) -> tuple[dict[str, np.ndarray], float | None]:
    """Divide state vectors into parts.

    Args:
        vectors: Features such as `observation.state`, each (D,) float32.
        parts: The parts of each feature and their sizes, as returned by `state_parts`.

    Returns:
        The parts for `Obs.state`, (size,) float32 each, and the value for `Obs.gripper`, or None if
        there is none.
    """
    state: dict[str, np.ndarray] = {}
    gripper = None
    for feature, parts_of_feature in parts.items():
        vector = vectors[feature]
        start = 0
        for name, dim in parts_of_feature:
            if name == GRIPPER and dim == 1:
                gripper = float(vector[start])
            else:
                state[name] = vector[start : start + dim]
            start += dim
    return state, gripper


def angles_in(name: str, unit: str | None, dim: int) -> range:
    """Return the indices of those angles in a part of the state that wrap at -pi and pi, according
    to its unit.

    The numbers of a rotation vector (`rotation_vector_in`) and of a quaternion are not such angles.
    """
    if rotation_vector_in(name, unit, dim) is not None:
        return range(0)
    if unit == "rad":
        return range(dim)
    if unit == "m+rad" and dim == 6:  # x, y, z, roll, pitch, yaw
        return range(3, 6)
    return range(0)


def rotation_vector_in(name: str, unit: str | None, dim: int) -> int | None:
    """Return the index of the first number of a rotation vector (axis times angle) in a part of the
    state, or None.

    Such a part has "axis" in its name, as in `xyz_axis_angle`, and only a position before the
    vector.
    """
    if "axis" not in name:
        return None
    return {("rad", 3): 0, ("m+rad", 6): 3}.get((unit or "", dim))


def usual_unit(name: str) -> str | None:
    """Return the usual unit of a state part with this name, for a dataset without a contract; None
    if there is no usual unit.
    """
    return next((unit for end, unit in _USUAL.items() if name.endswith(end)), None)


def centre_between(lowest: float, highest: float) -> float | None:
    """Return the centre of an angle, given only its range in the dataset; None if the range is
    within [-pi, pi].

    Wrapping around this centre does not change values within the range.
    """
    is_outside = max(-lowest, highest) > math.pi + _SLACK
    if not is_outside or highest - lowest >= _TURN:
        return None
    return (lowest + highest) / 2


def centre_of(episodes: Sequence[np.ndarray]) -> float | None:
    """Return the centre around which to wrap an angle, rad: the point opposite to the middle of the
    widest arc without values.

    Returns:
        The centre; None if the angle never jumps, within an episode or between episodes, or if its
        values exceed pi because it counts full turns.
    """
    values = np.concatenate(episodes).astype(np.float64)
    if (
        not len(values)
        or np.abs(values).max() > math.pi + _SLACK
        or np.abs(np.diff(values)).max(initial=0) <= math.pi
    ):
        return None

    circle = np.sort(values)
    arcs = np.diff(circle, append=circle[0] + _TURN)
    widest = int(arcs.argmax())
    opposite = circle[widest] + arcs[widest] / 2 + math.pi
    return round(float(_near(np.array(opposite), 0.0)), 6)


def rotation_centre_of(episodes: Sequence[np.ndarray]) -> tuple[float, float, float] | None:
    """Return the centre around which to wrap a rotation vector, rad: the mean of its rotations.

    Args:
        episodes: The rotation vector in each episode, (N, 3) rad.

    Returns:
        The centre, at most pi long; None if the vector never jumps, within an episode or between
        episodes, or if its length counts full turns.
    """
    vectors = np.concatenate(episodes).astype(np.float64)
    angles = np.linalg.norm(vectors, axis=1, keepdims=True)
    before, after = vectors[:-1], vectors[1:]
    if angles.max(initial=0) > _TURN + _SLACK or np.array_equal(_near_vector(after, before), after):
        return None

    # The mean of unit quaternions of either sign (Markley et al., Averaging Quaternions, 2007).
    quaternions = np.hstack([np.cos(angles / 2), np.sinc(angles / _TURN) * vectors / 2])  # w first
    mean = np.linalg.eigh(quaternions.T @ quaternions)[1][:, -1]
    mean *= np.copysign(1, mean[0])
    half = np.arctan2(np.linalg.norm(mean[1:]), mean[0])
    x, y, z = (round(float(number), 6) for number in mean[1:] * 2 / np.sinc(half / np.pi))
    return x, y, z


def _centre(value: Any) -> Centre:
    """Read the centre of an angle or a rotation vector from JSON."""
    if not isinstance(value, list):
        return float(value)
    x, y, z = map(float, value)
    return x, y, z


def _near_vector(vectors: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return equivalent rotation vectors, (..., 3), each the one nearest to `centre` of all that
    describe its rotation.

    Adding full turns to the angle about the same axis gives the same rotation. Vectors that are
    already nearest stay bit-identical, and a zero vector, which has no axis, stays zero.
    """
    angles = np.linalg.norm(vectors, axis=-1, keepdims=True)
    axes = np.divide(vectors, angles, out=np.zeros_like(vectors), where=angles > 0)
    nearest = _near(angles, (axes * centre).sum(axis=-1, keepdims=True))
    return np.where(nearest == angles, vectors, nearest * axes)


def _near(angles: np.ndarray, centre: float | np.ndarray) -> np.ndarray:
    """Shift angles by full turns to within pi of `centre`; angles already within that range stay
    bit-identical.
    """
    off = angles - centre
    return np.where(np.abs(off) > math.pi, centre + (off + math.pi) % _TURN - math.pi, angles)
