"""Whether a checkpoint fits an arm: the statistics of its training against the arm's present
state and limits.
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
from vlagents_ray.errors import ConfigError, ContractMismatch
from vlagents_ray.interface import Obs
from vlagents_ray.robot.limits import MotionLimits

logger = logging.getLogger(__name__)
# Share of the trained range by which a number may leave it: other tables and mounts differ a
# little.
_ROOM = 0.25
# A robot in other units is outside by such factors: 180 / pi, 1000.
_UNITS = {57.3: "degrees for radians", 1000.0: "millimetres for metres"}
_WIDTH = 32  # characters of a drawn range
_WANT = (
    "LeRobot's meta/stats.json, openpi's norm_stats.json or GR00T's statistics.json, with min "
    "and max or q01 and q99"
)
Span = tuple[np.ndarray, np.ndarray]  # lowest and highest of D numbers, (D,) each


@dataclass(frozen=True, slots=True)
class Trained:
    """The ranges of the numbers on which a checkpoint was trained; None if they are not stated."""

    state: Span | None = None
    action: Span | None = None
    parts: tuple[str, ...] | None = None  # of the state, in order; "gripper" is `Obs.gripper`

    @classmethod
    def read(cls, path: str | Path) -> Trained:
        """Read LeRobot's `stats.json`, openpi's `norm_stats.json` or GR00T's `statistics.json`.

        The range is that from `min` to `max`, or else from `q01` to `q99`. Of GR00T's groups, which
        are joined in the file's order, the file must have only one robot.

        Raises:
            ConfigError: The file is missing, or is none of these.
        """
        try:
            found: Any = json.loads(Path(path).read_text(encoding="utf-8"))
            found = found.get("norm_stats", found)
            if len(found) == 1 and {"state", "action"} <= set(next(iter(found.values()))):
                [found] = found.values()
            trained = cls.from_statistics(found)
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise ConfigError(
                f"statistics {path}: {type(error).__name__}: {error}; want {_WANT}"
            ) from error
        if trained.state is None and trained.action is None:
            raise ConfigError(f"statistics {path}: got {sorted(found)}, want {_WANT}")
        return trained

    @classmethod
    def from_statistics(cls, stated: Mapping[str, Any]) -> Trained:
        """Return the ranges in statistics, such as those in a server's metadata
        (`Agent.statistics`).
        """
        state, action = (
            next((_range(stated[key]) for key in keys if key in stated), None)
            for keys in (("observation.state", "state"), ("action", "actions"))
        )
        return cls(state, action, tuple(stated["parts"]) if "parts" in stated else None)

    def vector(self, obs: Obs, parts: Sequence[str]) -> np.ndarray | None:
        """Return the state in the order of the training, else of `parts`, (D,); None if it lacks
        one of them.
        """
        have, wanted = dict(obs.state), parts if self.parts is None else self.parts
        if obs.gripper is not None:
            have |= {
                "gripper": np.array([obs.gripper]),
                "gripper_closed": np.array([1 - obs.gripper]),
            }
        return (
            np.concatenate([have[part] for part in wanted])
            if wanted and have.keys() >= set(wanted)
            else None
        )

    def misfits(
        self,
        state: np.ndarray | None,
        chunk: np.ndarray | None,
        limits: MotionLimits | None,
        names: Sequence[str] = (),
    ) -> list[str]:
        """List what does not fit before the first motion, a sentence with the number and a cure
        each.

        Args:
            state: The arm's present state in the order of the training, (D,).
            chunk: The policy's first chunk, (H, D).
            limits: The limits of the arm.
            names: The names of the numbers by the arm's driver; default: those of `limits`.
        """
        stated = () if limits is None else limits.joints
        found = [
            (
                f"joints: number {number} is {ours!r} of the arm and {theirs!r} of its limits; use "
                "one order"
            )
            for number, ours, theirs in reordered(names, stated)
        ]
        names = [one.removesuffix(".pos") for one in names or stated]
        if self.state is not None and state is not None:
            found += _outside("state", state[np.newaxis], *self.state, names)
        if self.action is not None and chunk is not None:
            found += _outside("first chunk", chunk, *self.action, names)
        if limits is not None and self.action is not None:
            for limit, trained, sign in zip(
                limits.bounds(len(self.action[0])), self.action, (-1, 1), strict=True
            ):
                for i in np.flatnonzero(sign * (trained - limit) > 0):
                    found.append(
                        f"action{_name(int(i), names)}: was trained to {trained[i]:.4g}, the arm's "
                        f"limit is {limit[i]:.4g}; are they of another arm, or in another order?"
                    )
        return found

    def drawn(
        self, chunk: np.ndarray, limits: MotionLimits | None, names: Sequence[str] = ()
    ) -> list[str]:
        """Draw the first chunk, (H, D), beside the training's actions and the limits: a line for
        each number.
        """
        dim = chunk.shape[1]
        trained = (
            MotionLimits().bounds(dim)
            if self.action is None or len(self.action[0]) != dim
            else self.action
        )
        spans: list[Span] = [
            (limits or MotionLimits()).bounds(dim),
            trained,
            (chunk.min(0), chunk.max(0)),
        ]
        legend = "first chunk (#), training (-), limits (.)"
        lines = [f"{legend:<{_WIDTH + 22}}{'chunk':>20}{'training':>20}{'limits':>20}"]
        for i in range(dim):
            of_number = [(float(low[i]), float(high[i])) for low, high in spans]
            finite = [end for span in of_number for end in span if np.isfinite(end)] or [0.0]
            least, most = min(finite), max(finite)
            row = np.full(_WIDTH, " ")
            for mark, span in zip(".-#", of_number, strict=True):
                if np.isfinite(span).any():
                    places = (
                        (np.clip(span, least, most) - least)
                        / max(most - least, 1e-9)
                        * (_WIDTH - 1)
                    )
                    row[int(places[0]) : int(places[1]) + 1] = mark
            said = "".join(f"{f'{a:.3g} … {b:.3g}':>20}" for a, b in reversed(of_number))
            lines.append(f"{_name(i, names):<20}|{''.join(row)}|{said}")
        return lines


@dataclass(frozen=True, slots=True)
class Fit:
    """The numbers of a policy compared with those of an arm, before the first motion (see
    `loop.fit_of`).
    """

    trained: Trained
    limits: MotionLimits | None = None  # of the arm
    names: tuple[str, ...] = ()  # of the arm's joints, by its driver
    parts: tuple[str, ...] = ()  # of the state, in order, if the training names none
    accept: bool = False  # whether misfits are only logged

    @property
    def compares(self) -> bool:
        """Whether there is anything to compare with."""
        return self.trained != Trained() or self.limits is not None

    def drawn(self, rows: np.ndarray) -> list[str]:
        """Draw the first chunk, (H, D), beside the training's actions and the limits: a line for
        each number.
        """
        return self.trained.drawn(rows, self.limits, self.names)

    def require(self, obs: Obs | None, rows: np.ndarray | None) -> None:
        """Compare an observation of the arm at rest and the policy's first chunk with the training
        and the limits.

        Args:
            obs: The observation; None compares only the chunk.
            rows: The chunk, (H, D); None compares only the observation.

        Raises:
            ContractMismatch: Something does not fit, and `accept` is off.
        """
        if not self.compares:
            return
        state = None if obs is None else self.trained.vector(obs, self.parts)
        limits = None if obs is None else self.limits
        require_fit(self.trained.misfits(state, rows, limits, self.names), accept=self.accept)


def require_fit(misfits: Sequence[str], *, accept: bool = False) -> None:
    """Raise `ContractMismatch` with every misfit; with `accept`, log them as warnings instead."""
    if not misfits:
        return
    text = "the checkpoint does not fit this arm:\n" + "\n".join(f"- {line}" for line in misfits)
    if not accept:
        raise ContractMismatch(text)
    logger.warning("accepted although %s", text)


def _range(stated: Mapping[str, Any]) -> Span:
    if stated and all(isinstance(one, Mapping) for one in stated.values()):  # groups
        lows, highs = zip(*map(_range, stated.values()), strict=True)
        return np.concatenate(lows), np.concatenate(highs)
    low, high = ("min", "max") if "min" in stated else ("q01", "q99")
    return np.ravel(np.asarray(stated[low], np.float64)), np.ravel(
        np.asarray(stated[high], np.float64)
    )


def _outside(
    what: str, rows: np.ndarray, low: np.ndarray, high: np.ndarray, names: Sequence[str]
) -> list[str]:
    """List the numbers of rows, (H, D), that are outside of the trained range."""
    if rows.shape[1] != len(low):
        return [
            (
                f"{what}: got {rows.shape[1]} numbers, was trained with {len(low)}; is this "
                "another arm's checkpoint?"
            )
        ]
    room, found = _ROOM * (high - low) + 1e-3, []
    least, most = rows.min(0), rows.max(0)
    for i in np.flatnonzero((least < low - room) | (most > high + room)):
        got = least[i] if least[i] < low[i] - room[i] else most[i]
        ratio = abs(got) / max(abs(low[i]), abs(high[i]), 1e-9)
        unit = next(
            (f"; {said}?" for factor, said in _UNITS.items() if 0.2 * factor < ratio < 2 * factor),
            "",
        )
        fits = [
            j for j in range(len(low)) if j != i and low[j] - room[j] <= got <= high[j] + room[j]
        ]
        order = (
            f"; it would fit number {_name(fits[0], names)}: another order?"
            if fits and not unit
            else ""
        )
        trained = f"was trained from {low[i]:.4g} to {high[i]:.4g}"
        found.append(f"{what}{_name(int(i), names)}: got {got:.4g}, {trained}{unit or order}")
    return found


def _name(i: int, names: Sequence[str]) -> str:
    return f"[{i}] ({names[i]})" if i < len(names) else f"[{i}]"
