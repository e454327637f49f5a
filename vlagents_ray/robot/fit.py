"""Whether a checkpoint fits an arm: the statistics of its training against the arm's present state and limits."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError, ContractMismatch
from vlagents_ray.robot.limits import Limits

logger = logging.getLogger(__name__)
_ROOM = 0.25  # share of the trained range by which a number may leave it: other tables and mounts differ a little
# A robot in other units is outside by such factors: 180 / pi, 1000.
_UNITS = {57.3: "degrees for radians", 1000.0: "millimetres for metres"}


@dataclass(frozen=True, slots=True)
class Trained:
    """The ranges of the numbers on which a checkpoint was trained; None if they are not stated."""

    state: tuple[np.ndarray, np.ndarray] | None  # lowest and highest, (D,) each
    action: tuple[np.ndarray, np.ndarray] | None

    @classmethod
    def read(cls, path: str | Path) -> Trained:
        """Read LeRobot's `stats.json`, openpi's `norm_stats.json` or GR00T's `statistics.json`.

        The range is that from `min` to `max`, or else from `q01` to `q99`. Of GR00T's groups, which are joined in the
        file's order, the file must have only one robot.

        Raises:
            ConfigError: The file is missing, or is none of these.
        """
        try:
            found: Any = json.loads(Path(path).read_text(encoding="utf-8"))
            found = found.get("norm_stats", found)
            if len(found) == 1 and {"state", "action"} <= set(next(iter(found.values()))):
                [found] = found.values()
            state, action = (
                next((_range(found[key]) for key in keys if key in found), None)
                for keys in (("observation.state", "state"), ("action", "actions"))
            )
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise ConfigError(f"statistics {path}: {type(error).__name__}: {error}; want {_WANT}") from error
        if state is None and action is None:
            raise ConfigError(f"statistics {path}: got {sorted(found)}, want {_WANT}")
        return cls(state, action)

    def misfits(
        self, state: np.ndarray | None, chunk: np.ndarray | None, limits: Limits | None, names: Sequence[str] = ()
    ) -> list[str]:
        """List what does not fit before the first motion, a sentence with the number and a cure each.

        Args:
            state: The arm's present state in the order of the training, (D,).
            chunk: The policy's first chunk, (H, D).
            limits: The limits of the arm.
            names: The names of the numbers; default: those of `limits`.
        """
        names = names or (() if limits is None else limits.joints)
        found = []
        if self.state is not None and state is not None:
            found += _outside("state", state[np.newaxis], *self.state, names)
        if self.action is not None and chunk is not None:
            found += _outside("first chunk", chunk, *self.action, names)
        if limits is not None and self.action is not None:
            for bound, trained, sign in ((limits.low, self.action[0], -1), (limits.high, self.action[1], 1)):
                if bound is None or np.shape(bound) not in ((), trained.shape):
                    continue
                for i in np.flatnonzero(sign * (trained - np.asarray(bound, np.float64)) > 0):
                    limit = np.broadcast_to(bound, trained.shape)[i]
                    found.append(
                        f"action{_name(int(i), names)}: was trained to {trained[i]:.4g}, the arm's limit is "
                        f"{limit:.4g}; are they of another arm, or in another order?"
                    )
        return found


_WANT = (
    "LeRobot's meta/stats.json, openpi's norm_stats.json or GR00T's statistics.json, with min and max or q01 and q99"
)


def require_fit(misfits: Sequence[str], *, accept: bool = False) -> None:
    """Raise `ContractMismatch` with every misfit; with `accept`, log them as warnings instead."""
    if not misfits:
        return
    text = "the checkpoint does not fit this arm:\n" + "\n".join(f"- {line}" for line in misfits)
    if not accept:
        raise ContractMismatch(text)
    logger.warning("accepted although %s", text)


def _range(stated: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    if stated and all(isinstance(one, Mapping) for one in stated.values()):  # groups
        lows, highs = zip(*map(_range, stated.values()), strict=True)
        return np.concatenate(lows), np.concatenate(highs)
    low, high = ("min", "max") if "min" in stated else ("q01", "q99")
    return np.ravel(np.asarray(stated[low], np.float64)), np.ravel(np.asarray(stated[high], np.float64))


def _outside(what: str, rows: np.ndarray, low: np.ndarray, high: np.ndarray, names: Sequence[str]) -> list[str]:
    """List the numbers of rows, (H, D), that are outside of the trained range."""
    if rows.shape[1] != len(low):
        return [f"{what}: got {rows.shape[1]} numbers, was trained with {len(low)}; is this another arm's checkpoint?"]
    room, found = _ROOM * (high - low) + 1e-3, []
    least, most = rows.min(0), rows.max(0)
    for i in np.flatnonzero((least < low - room) | (most > high + room)):
        got = least[i] if least[i] < low[i] - room[i] else most[i]
        ratio = abs(got) / max(abs(low[i]), abs(high[i]), 1e-9)
        unit = next((f"; {said}?" for factor, said in _UNITS.items() if 0.2 * factor < ratio < 2 * factor), "")
        fits = [j for j in range(len(low)) if j != i and low[j] - room[j] <= got <= high[j] + room[j]]
        order = f"; it would fit number {_name(fits[0], names)}: another order?" if fits and not unit else ""
        trained = f"was trained from {low[i]:.4g} to {high[i]:.4g}"
        found.append(f"{what}{_name(int(i), names)}: got {got:.4g}, {trained}{unit or order}")
    return found


def _name(i: int, names: Sequence[str]) -> str:
    return f"[{i}] ({names[i]})" if i < len(names) else f"[{i}]"
