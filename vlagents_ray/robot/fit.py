"""Checks whether a checkpoint fits an arm: compares the statistics of the training data with the
arm's present state and limits.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import reordered
from vlagents_ray.errors import ConfigError, ContractMismatch, shown
from vlagents_ray.interface import Obs
from vlagents_ray.robot.limits import MotionLimits

logger = logging.getLogger(__name__)
# Tolerance beyond the trained range, as a share of the range, since tables and mounts differ a
# little.
_TOLERANCE = 0.25
# Factor between a robot's numbers in a wrong unit (180 / pi, 1000) and the range -> the likely
# mistake.
_UNIT_MISTAKES = {57.3: "degrees for radians", 1000.0: "millimetres for metres"}
_WIDTH = 32  # width of a drawn range in characters
_ACCEPTED_FILES = (
    "LeRobot's meta/stats.json, openpi's norm_stats.json or GR00T's statistics.json, with min "
    "and max or q01 and q99"
)
# Exceptions that statistics of an unexpected form can raise.
_UNREADABLE = (
    OSError,
    ArithmeticError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    RecursionError,
)
Span = tuple[np.ndarray, np.ndarray]  # lowest and highest values of D numbers, (D,) each


@dataclass(frozen=True, slots=True)
class Trained:
    """The ranges of the states and actions on which a checkpoint was trained; None if unknown."""

    state: Span | None = None
    action: Span | None = None
    # The names of the state's parts, in order; "gripper" is `Obs.gripper`.
    state_names: tuple[str, ...] | None = None

    @classmethod
    def read(cls, path: str | Path) -> Trained:
        """Read LeRobot's `stats.json`, openpi's `norm_stats.json` or GR00T's `statistics.json`.

        A range is from `min` to `max`; without these keys, from `q01` to `q99`. GR00T's groups of
        numbers are joined in the order of the file, which must contain the statistics of only one
        robot.

        Args:
            path: The file.

        Returns:
            The ranges of state and action.

        Raises:
            ConfigError: The file is missing, or has none of these formats.
        """
        try:
            statistics: Any = json.loads(Path(path).read_text(encoding="utf-8"))
            statistics = statistics.get("norm_stats", statistics)

            # In GR00T's files, the only key is the name of the robot.
            if len(statistics) == 1:
                [robot_statistics] = statistics.values()
                if {"state", "action"} <= set(robot_statistics):
                    statistics = robot_statistics
            trained = cls._read(statistics)
        except _UNREADABLE as error:
            raise ConfigError(
                f"statistics {path}: expected {_ACCEPTED_FILES}, got {type(error).__name__}: "
                f"{error}"
            ) from error
        if trained.state is None and trained.action is None:
            raise ConfigError(
                f"statistics {path}: expected {_ACCEPTED_FILES}, got {sorted(statistics)}"
            )
        return trained

    @classmethod
    def from_statistics(cls, statistics: object) -> Trained:
        """Return the ranges in statistics, such as the statistics in a server's metadata
        (`vlagents_ray.abilities.HasStatistics`), whose type is not trusted.

        Args:
            statistics: The ranges by the names "observation.state" or "state", and "action" or
                "actions"; and "parts", the names of the state's parts.

        Returns:
            The ranges of state and action; None for a range that the statistics lack.

        Raises:
            ConfigError: The argument is not statistics.
        """
        try:
            return cls._read(statistics)
        except _UNREADABLE as error:
            raise ConfigError(
                "the policy's statistics: expected ranges, min and max or q01 and q99, by name, "
                f"got {shown(statistics)} ({type(error).__name__}); pass a statistics file instead"
            ) from error

    @classmethod
    def _read(cls, statistics: Any) -> Trained:
        """Return the ranges in statistics; raises one of `_UNREADABLE` for invalid statistics."""
        state = _first_range(statistics, ("observation.state", "state"))
        action = _first_range(statistics, ("action", "actions"))
        state_names = tuple(statistics["parts"]) if "parts" in statistics else None
        if not all(isinstance(name, str) for name in state_names or ()):
            raise TypeError("parts")
        return cls(state, action, state_names)

    def vector(self, obs: Obs, default_names: Sequence[str]) -> np.ndarray | None:
        """Return the state of an observation in the order of the training.

        Args:
            obs: The observation.
            default_names: The names of the state's parts, in order, if the statistics contain no
                names.

        Returns:
            The state, (D,); None if the observation lacks one of its parts.
        """
        values = dict(obs.state)
        if obs.gripper is not None:
            values["gripper"] = np.array([obs.gripper])
            values["gripper_closed"] = np.array([1 - obs.gripper])

        names = default_names if self.state_names is None else self.state_names
        if not names or not values.keys() >= set(names):
            return None
        return np.concatenate([values[name] for name in names])

    def misfits(
        self,
        state: np.ndarray | None,
        chunk: np.ndarray | None,
        limits: MotionLimits | None,
        names: Sequence[str] = (),
    ) -> list[str]:
        """List the numbers that do not fit, before the first motion; each entry is a sentence with
        its cure.

        Args:
            state: The arm's present state in the order of the training, (D,).
            chunk: The policy's first chunk, (H, D).
            limits: The limits of the arm.
            names: The driver's names of the numbers; default: the names in `limits`.

        Returns:
            The sentences; none if everything fits.
        """
        joints = () if limits is None else limits.joints
        sentences = []
        for number, ours, theirs in reordered(names, joints):
            sentences.append(
                f"joints: number {number} is {ours!r} in the arm and {theirs!r} in its limits; use "
                f"the same order"
            )

        names = [name.removesuffix(".pos") for name in names or joints]
        if self.state is not None and state is not None:
            sentences += _outside("state", state[np.newaxis], *self.state, names)
        if self.action is not None and chunk is not None:
            sentences += _outside("first chunk", chunk, *self.action, names)

        if limits is not None and self.action is not None:
            low_limits, high_limits = limits.bounds(len(self.action[0]))
            low_trained, high_trained = self.action
            sentences += _beyond(low_trained, low_limits, low_trained < low_limits, names)
            sentences += _beyond(high_trained, high_limits, high_trained > high_limits, names)
        return sentences

    def draw(
        self, chunk: np.ndarray, limits: MotionLimits | None, names: Sequence[str] = ()
    ) -> list[str]:
        """Draw the first chunk, the training's actions and the limits below each other.

        Args:
            chunk: The policy's first chunk, (H, D).
            limits: The limits of the arm.
            names: The names of the numbers of an action.

        Returns:
            A legend, and a line for each number.
        """
        dim = chunk.shape[1]
        trained = self.action
        if trained is None or len(trained[0]) != dim:
            trained = MotionLimits().bounds(dim)  # infinite: no limit
        spans: list[Span] = [
            (limits or MotionLimits()).bounds(dim),
            trained,
            (chunk.min(0), chunk.max(0)),
        ]

        legend = "first chunk (#), training (-), limits (.)"
        lines = [f"{legend:<{_WIDTH + 22}}{'chunk':>20}{'training':>20}{'limits':>20}"]
        for i in range(dim):
            ranges = [(float(low[i]), float(high[i])) for low, high in spans]
            numbers = ""
            for low_end, high_end in reversed(ranges):
                text = f"{low_end:.3g} … {high_end:.3g}"
                numbers += f"{text:>20}"
            lines.append(f"{_name(i, names):<20}|{_bars(ranges)}|{numbers}")
        return lines


@dataclass(frozen=True, slots=True)
class Fit:
    """Compares the numbers of a policy with the numbers of an arm, before the first motion (see
    `loop.fit_of`).
    """

    trained: Trained
    limits: MotionLimits | None = None  # the limits of the arm
    names: tuple[str, ...] = ()  # the driver's names of the arm's joints
    # The names of the state's parts, in order, if the statistics contain no names.
    state_names: tuple[str, ...] = ()
    accept: bool = False  # whether misfits are only logged

    @property
    def compares(self) -> bool:
        """Whether there are ranges or limits to compare with."""
        return self.trained != Trained() or self.limits is not None

    def draw(self, rows: np.ndarray) -> list[str]:
        """Draw the first chunk, (H, D), the training's actions and the limits; see
        `Trained.draw`.
        """
        return self.trained.draw(rows, self.limits, self.names)

    def require(self, obs: Obs | None, rows: np.ndarray | None) -> None:
        """Compare an observation of the arm at rest and the policy's first chunk with the training
        data and the limits.

        Args:
            obs: The observation; None compares only the chunk.
            rows: The chunk, (H, D); None compares only the observation.

        Raises:
            ContractMismatch: A number does not fit, and `accept` is False.
        """
        if not self.compares:
            return
        state = None
        limits = None
        if obs is not None:
            state = self.trained.vector(obs, self.state_names)
            limits = self.limits
        misfits = self.trained.misfits(state, rows, limits, self.names)
        require_fit(misfits, accept=self.accept)


def require_fit(misfits: Sequence[str], *, accept: bool = False) -> None:
    """Raise an error if a checkpoint does not fit an arm.

    Args:
        misfits: The sentences about the numbers that do not fit.
        accept: Whether the misfits are only logged as a warning.

    Raises:
        ContractMismatch: There are misfits, and `accept` is False.
    """
    if not misfits:
        return
    text = "the checkpoint does not fit this arm:\n" + "\n".join(f"- {line}" for line in misfits)
    if not accept:
        raise ContractMismatch(text)
    logger.warning("accepted although %s", text)


def _first_range(statistics: Mapping[str, Any], keys: Sequence[str]) -> Span | None:
    """Return the range under the first of the keys that the statistics contain; None if they
    contain none of the keys.
    """
    for key in keys:
        if key in statistics:
            return _range(statistics[key])
    return None


def _range(statistics: Mapping[str, Any]) -> Span:
    """Return the range of a vector's statistics; the ranges of several groups are joined."""
    if statistics and all(isinstance(group, Mapping) for group in statistics.values()):
        lows, highs = zip(*map(_range, statistics.values()), strict=True)
        return np.concatenate(lows), np.concatenate(highs)

    low_key, high_key = ("min", "max") if "min" in statistics else ("q01", "q99")
    low = np.ravel(np.asarray(statistics[low_key], np.float64))
    high = np.ravel(np.asarray(statistics[high_key], np.float64))
    if low.shape != high.shape:
        raise ValueError(f"{low_key} of {len(low)} numbers, {high_key} of {len(high)}")
    return low, high


def _bars(ranges: Sequence[tuple[float, float]]) -> str:
    """Draw the ranges of a number in limits, training and chunk on one line of `_WIDTH`
    characters.
    """
    ends = np.ravel(ranges)
    finite = ends[np.isfinite(ends)].tolist() or [0.0]
    lowest, highest = min(finite), max(finite)

    characters = np.full(_WIDTH, " ")
    width = max(highest - lowest, 1e-9)
    for mark, low_high in zip(".-#", ranges, strict=True):
        if np.isfinite(low_high).any():
            shares = (np.clip(low_high, lowest, highest) - lowest) / width
            first, last = (shares * (_WIDTH - 1)).astype(int)
            characters[first : last + 1] = mark
    return "".join(characters)


def _outside(
    vector: str, rows: np.ndarray, low: np.ndarray, high: np.ndarray, names: Sequence[str]
) -> list[str]:
    """List the numbers in rows, (H, D), that are outside the trained range.

    Args:
        vector: The name of the vector for messages: "state" or "first chunk".
        rows: The rows.
        low: The lowest numbers of the training, (D,).
        high: The highest numbers of the training, (D,).
        names: The names of the numbers, if they are known.

    Returns:
        A sentence about each of these numbers.
    """
    if rows.shape[1] != len(low):
        sentence = (
            f"{vector}: expected {len(low)} numbers, as the policy was trained with, got "
            f"{rows.shape[1]}; is this another arm's checkpoint?"
        )
        return [sentence]

    tolerance = _TOLERANCE * (high - low) + 1e-3
    allowed_low, allowed_high = low - tolerance, high + tolerance
    lowest, highest = rows.min(0), rows.max(0)
    sentences = []
    for i in np.flatnonzero((lowest < allowed_low) | (highest > allowed_high)):
        number = lowest[i] if lowest[i] < allowed_low[i] else highest[i]

        hint = ""
        ratio = abs(number) / max(abs(low[i]), abs(high[i]), 1e-9)
        for factor, mistake in _UNIT_MISTAKES.items():
            if not hint and 0.2 * factor < ratio < 2 * factor:
                hint = f"; {mistake}?"
        fitting = np.flatnonzero((allowed_low <= number) & (number <= allowed_high))
        if fitting.size and not hint:
            hint = f"; it would fit number {_name(int(fitting[0]), names)}: another order?"

        sentences.append(
            f"{vector}{_name(int(i), names)}: expected {low[i]:.4g} to {high[i]:.4g}, the range "
            f"of the training, got {number:.4g}{hint}"
        )
    return sentences


def _beyond(
    trained: np.ndarray, limits: np.ndarray, is_beyond: np.ndarray, names: Sequence[str]
) -> list[str]:
    """List the bounds of the trained range, (D,), that exceed the limits, (D,)."""
    sentences = []
    for i in np.flatnonzero(is_beyond):
        sentences.append(
            f"action{_name(int(i), names)}: was trained to {trained[i]:.4g}, the arm's limit is "
            f"{limits[i]:.4g}; are they of another arm, or in another order?"
        )
    return sentences


def _name(i: int, names: Sequence[str]) -> str:
    """Return the index of a number, with the number's name if it is known."""
    return f"[{i}] ({names[i]})" if i < len(names) else f"[{i}]"
