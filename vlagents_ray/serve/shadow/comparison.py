"""Two policies side by side: whether they can be compared, and how far their actions for an observation differ."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vlagents_ray.contract import Contract, differences
from vlagents_ray.errors import ConfigError


@dataclass(frozen=True, slots=True)
class ActionDifference:
    """The difference between two actions for the same observation, in the units of the action."""

    rows: int  # rows that were compared, R: the shorter of the two chunks
    by_joint: np.ndarray  # (D,) mean absolute difference over the rows
    first_row: np.ndarray  # (D,) absolute difference in the first row that was compared
    cosine: float  # of the rows of both, flattened, in [-1, 1]; 1 if both are zero, 0 if one is

    @property
    def mean(self) -> float:
        """Mean absolute difference over rows and joints."""
        return float(self.by_joint.mean())


def action_difference(live: np.ndarray, candidate: np.ndarray) -> ActionDifference:
    """Compare the action of a candidate with that of the live policy.

    Args:
        live: (D,) or (H, D).
        candidate: (D,) or (H', D). Rows that only one of the two has are not compared.

    Raises:
        ValueError: The actions have rows of different lengths, or no rows.
    """
    ours, theirs = np.atleast_2d(live).astype(np.float64), np.atleast_2d(candidate).astype(np.float64)
    rows = min(len(ours), len(theirs))
    if ours.shape[1:] != theirs.shape[1:] or rows == 0:
        raise ValueError(f"candidate's action: got {candidate.shape}, want rows as in {live.shape}")
    ours, theirs = ours[:rows], theirs[:rows]
    apart = np.abs(ours - theirs)
    lengths = np.linalg.norm(ours) * np.linalg.norm(theirs)
    cosine = float(np.vdot(ours, theirs) / lengths) if lengths else float(not (ours.any() or theirs.any()))
    return ActionDifference(rows, apart.mean(axis=0), apart[0], min(1.0, max(-1.0, cosine)))


def require_comparable(live: Contract | None, candidate: Contract | None) -> None:
    """Check that a candidate can act on the live policy's observations, and that its actions mean the same.

    Chunks may differ in length. What a contract does not state is not compared.

    Args:
        live: The contract of the live policy.
        candidate: The contract of the candidate.

    Raises:
        ConfigError: They do not fit, with every difference.
    """
    if live is None or candidate is None:
        return
    found = differences(candidate, replace(live, chunk=None))
    if found:
        raise ConfigError(  # on one line, since `serve status` ends with the last one
            f"shadow: the candidate (the policy, below) does not fit what the live policy gets and returns (the env): "
            f"{'. '.join(found)}. Serve a candidate for the same robot and control mode; its `wrappers` can adapt it"
        )
