"""The success of a policy by the delay of its answers, which is stored beside its checkpoint.

A robot that always has an action in time can still fail, since each action was computed from an
observation of the past. `SuccessCurve` contains what was measured for a policy: how many episodes
were solved at each delay. Delays are in *rows*, which are ticks of the environment's rate, since a
policy's loss depends on the motion during the delay. `benchmarks.delays` measures curves and
writes them into the file `success.json` in the folder of a checkpoint, and `read_curves` reads
them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vlagents_ray.bounds import MOST_EPISODES, MOST_HZ, MOST_ROWS
from vlagents_ray.errors import ConfigError, InvalidInput, MalformedMessage, shown
from vlagents_ray.foreign_files import read_text

SUCCESS_FILE = "success.json"
"""The name of the file with curves in the folder of a checkpoint."""
Z_95 = 1.959963984540054  # two-sided 95 % quantile of the standard normal distribution
# The share of the synchronous success rate that a tolerated delay must keep: a loss of one task in
# twenty is about the width of the interval of 500 episodes.
_KEPT = 0.95
_MOST_TICKS = 10**9  # ticks of an episode; more are a mistake


def wilson(successes: float, trials: float, z: float = Z_95) -> tuple[float, float]:
    """Compute the Wilson score interval of a success probability.

    E. B. Wilson, "Probable Inference, the Law of Succession, and Statistical Inference", JASA 22
    (1927). Unlike the textbook interval it stays inside [0, 1] and is accurate for few episodes and
    for rates of 0 % and 100 %.

    Args:
        successes: The number of successful trials; a fraction if starts are repeated.
        trials: The number of trials, or of independent trials (`independent_episodes`).
        z: The quantile of the standard normal distribution; the default gives 95 %.

    Returns:
        (low, high), each in [0, 1]; (0, 1) when there are no trials.

    Raises:
        InvalidInput: `successes` is not in 0 … `trials`.
    """
    if not 0 <= successes <= trials:
        raise InvalidInput(
            f"wilson: expected 0 <= successes <= trials, got {successes} successes in {trials} "
            "trials"
        )
    if trials == 0:
        return 0.0, 1.0

    rate = successes / trials
    scale = 1 + z * z / trials
    centre = (rate + z * z / (2 * trials)) / scale
    half_width = z / scale * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))

    # Without successes the lower bound is exactly 0, and without failures the upper bound is
    # exactly 1. Floating point would give 1e-17 and 1 - 1e-16.
    low = 0.0 if successes == 0 else centre - half_width
    high = 1.0 if successes == trials else centre + half_width
    return low, high


class Solved(NamedTuple):
    """The episodes at one delay."""

    solved: int  # number of solved episodes
    episodes: int  # number of all episodes, at least 1
    ticks: float  # mean number of ticks of an episode, failed ones included


@dataclass(frozen=True)
class SuccessCurve:
    """How many episodes of an environment a policy solves, by the delay of its answers.

    Args:
        env: The name of the environment, such as "tabletop".
        hz: The rate of its ticks, 1/s.
        mode: The mode in which chunks were executed, such as "async".
        settings: The other settings of the execution, such as `{"execute": 4}`: values of JSON.
        solved: The episodes by delay, in rows; an entry for a delay of 0 is required, since it is
            the synchronous success.
        weights: The digest of the weights (`weights_of`); None if it is unknown.

    Raises:
        InvalidInput: A value has no meaning.
    """

    env: str
    hz: float
    mode: str
    settings: Mapping[str, Any]
    solved: Mapping[int, Solved]
    weights: str | None = None
    _rows: np.ndarray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("env", "mode"):
            value = getattr(self, name)
            if not isinstance(value, str) or not value:
                raise _invalid(name, "a name", value)
        if self.weights is not None and not isinstance(self.weights, str):
            raise _invalid("weights", "a digest or null", self.weights)
        if not _is_number(self.hz) or not 0 < self.hz <= MOST_HZ:
            raise _invalid("hz", f"a rate in 1/s, above 0 and at most {MOST_HZ}", self.hz)
        try:
            settings = json.loads(json.dumps(dict(self.settings), allow_nan=False))
        except (TypeError, ValueError, RecursionError) as error:
            raise _invalid("settings", "an object of JSON", self.settings) from error

        if not isinstance(self.solved, Mapping) or 0 not in self.solved:
            raise _invalid("solved", "the episodes by delay, with a delay of 0", self.solved)
        solved: dict[int, Solved] = {}
        for rows in sorted(self.solved, key=_delay):
            solved[rows] = _checked(rows, self.solved[rows])

        # Copies, so that no later change of the caller's values changes the curve.
        object.__setattr__(self, "settings", settings)
        object.__setattr__(self, "solved", solved)
        object.__setattr__(self, "_rows", np.fromiter(solved, float))

    def floor(self, rows: float) -> float:
        """Return the lower bound of the 95 % interval (Wilson) of the success rate at a delay.

        Between two measured delays it is linear. Beyond the longest one it is 0, since nothing is
        known there.

        Args:
            rows: The delay, in rows; at least 0.

        Raises:
            InvalidInput: The delay is not a number of at least 0.
        """
        bounds = [wilson(one.solved, one.episodes)[0] for one in self.solved.values()]
        return self._at(rows, bounds)

    def tasks_per_hour(self, rows: float) -> float:
        """Return the number of tasks that a robot solves in an hour at a delay, without the time
        between episodes; linear between two measured delays, and 0 beyond the longest one.

        Args:
            rows: The delay, in rows; at least 0.

        Raises:
            InvalidInput: The delay is not a number of at least 0.
        """
        per_tick = [one.solved / one.episodes / one.ticks for one in self.solved.values()]
        return self._at(rows, per_tick) * self.hz * 3600

    @property
    def tolerated(self) -> int:
        """The tolerated delay, in rows: the longest measured delay for which `floor`, also at each
        shorter measured delay, is at least 0.95 of the synchronous success rate.

        It is 0 if no longer delay keeps this rate, or too few episodes show it.
        """
        synchronous = self.solved[0].solved / self.solved[0].episodes
        tolerated = 0
        for rows in self.solved:
            if rows and self.floor(rows) < _KEPT * synchronous:
                break
            tolerated = rows
        return tolerated

    def to_json(self) -> dict[str, Any]:
        """Return the curve as values of JSON, which `from_json` reads."""
        return {
            "env": self.env,
            "hz": self.hz,
            "mode": self.mode,
            "settings": dict(self.settings),
            "weights": self.weights,
            "delays": [{"rows": rows, **one._asdict()} for rows, one in self.solved.items()],
        }

    @classmethod
    def from_json(cls, document: Any) -> SuccessCurve:
        """Return the curve in a document of `to_json`.

        Raises:
            InvalidInput: The document is not a curve.
        """
        names = {"env", "hz", "mode", "settings", "weights", "delays"}
        if not isinstance(document, Mapping) or document.keys() != names:
            raise _invalid("curve", f"an object with {sorted(names)}", document)
        if not isinstance(document["delays"], list):
            raise _invalid("delays", "a list", document["delays"])

        solved: dict[int, Solved] = {}
        for entry in document["delays"]:
            fields = {"rows", *Solved._fields}
            if not isinstance(entry, Mapping) or entry.keys() != fields:
                raise _invalid("delays", f"objects with {sorted(fields)}", entry)
            rows = _delay(entry["rows"])
            if rows in solved:
                raise _invalid("delays", "each number of rows once", rows)
            solved[rows] = Solved(*(entry[name] for name in Solved._fields))
        rest = {name: document[name] for name in ("env", "hz", "mode", "settings", "weights")}
        return cls(**rest, solved=solved)

    def _at(self, rows: float, values: Sequence[float]) -> float:
        """Return the value at a delay, of the values at each measured delay."""
        if not _is_number(rows) or not 0 <= rows < math.inf:
            raise _invalid("rows", "a delay in rows, at least 0", rows)
        return float(np.interp(rows, self._rows, values, right=0.0))


def read_curves(folder: Path) -> list[SuccessCurve]:
    """Return the curves in the folder of a checkpoint; none if it has no file of curves.

    Raises:
        ConfigError: The file is not one of `write_curves`.
    """
    file = folder / SUCCESS_FILE
    if not file.exists():
        return []
    try:
        document = json.loads(read_text(file))
        if not isinstance(document, dict) or not isinstance(document.get("curves"), list):
            raise _invalid("file", "an object with a list of `curves`", document)
        return [SuccessCurve.from_json(curve) for curve in document["curves"]]
    except (ValueError, RecursionError) as error:
        raise ConfigError(
            f"{file}: expected curves of success, got an error: {error}; measure them again with "
            "benchmarks.delays, or remove the file"
        ) from error


def write_curves(folder: Path, curves: Iterable[SuccessCurve]) -> Path:
    """Write curves into the folder of a checkpoint in place of earlier ones, and return the
    file.
    """
    file = folder / SUCCESS_FILE
    document = {"curves": [curve.to_json() for curve in curves]}
    file.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return file


def curves_in(metadata: Mapping[str, Any]) -> tuple[SuccessCurve, ...]:
    """Return the measured success of the checkpoint in the metadata of a policy; none if a learner
    has replaced its weights.

    Raises:
        MalformedMessage: The metadata contain no curves there.
    """
    curves = weights_in(metadata).get("success") or []
    if not isinstance(curves, list):
        raise MalformedMessage(
            f"metadata: weights.success: expected a list of curves, got {shown(curves)}"
        )
    if _is_replaced(metadata.get("policy_version")):
        return ()
    try:
        return tuple(SuccessCurve.from_json(curve) for curve in curves)
    except InvalidInput as error:
        raise MalformedMessage(f"metadata: weights.success: {error}") from error


def weights_in(metadata: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the description of the weights in the metadata of a policy; empty if there is none.

    Raises:
        MalformedMessage: The metadata contain no description there.
    """
    weights = metadata.get("weights") or {}
    if not isinstance(weights, dict):
        raise MalformedMessage(f"metadata: weights: expected an object, got {shown(weights)}")
    return weights


def _is_replaced(versions: object) -> bool:
    """Return whether the newest or the pinned weights of a policy are not those that it loaded,
    given its `policy_version`.
    """
    if not isinstance(versions, dict):
        return False
    described = [version for version in versions.values() if isinstance(version, dict)]
    return any(version.get("version") for version in described)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _delay(rows: object) -> int:
    """Return a delay in rows; raises `InvalidInput` if it is not a number of rows."""
    if isinstance(rows, bool) or not isinstance(rows, int) or not 0 <= rows <= MOST_ROWS:
        raise _invalid("delay", f"a whole number of rows from 0 to {MOST_ROWS}", rows)
    return rows


def _checked(rows: int, entry: object) -> Solved:
    """Return the episodes at a delay.

    Raises:
        InvalidInput: They are not possible.
    """
    if not isinstance(entry, tuple | list) or len(entry) != len(Solved._fields):
        raise _invalid(f"delay {rows}", f"{Solved._fields}", entry)
    solved, episodes, ticks = entry
    are_counts = type(solved) is type(episodes) is int
    if not are_counts or not 0 <= solved <= episodes or not 1 <= episodes <= MOST_EPISODES:
        expected = f"0 <= solved <= episodes, and 1 to {MOST_EPISODES} episodes"
        raise _invalid(f"delay {rows}", expected, entry)
    if not _is_number(ticks) or not 0 < ticks <= _MOST_TICKS:
        raise _invalid(f"delay {rows}", f"a mean number of ticks up to {_MOST_TICKS}", entry)
    return Solved(solved, episodes, float(ticks))


def _invalid(name: str, expected: str, value: object) -> InvalidInput:
    return InvalidInput(f"{name}: expected {expected}, got {shown(value)}")
