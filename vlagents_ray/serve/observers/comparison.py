"""The side of the candidate: how far its actions differ from the live policy's, counted and recorded."""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract, differences
from vlagents_ray.errors import ConfigError, NotReset, UnknownSession
from vlagents_ray.interface import POLICY, Act
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.metrics_buffer import Sample

logger = logging.getLogger(__name__)

_PARTS = 8  # files of a replica's comparisons at most, so that the oldest eighth goes at once


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


class ComparisonLog:
    """Appends to `APP-REPLICA.jsonl`, `APP-REPLICA.1.jsonl` and so on, and deletes the application's oldest files.

    Only this replica of the candidate writes its files. All files of the application have `limit` bytes at most, but
    for one write. Raises `OSError` if the folder cannot be made or read.
    """

    def __init__(self, folder: Path, app: str, replica: str, limit: int) -> None:
        self._folder = folder
        self._stem = f"{app}-{replica}"
        self._own = re.compile(re.escape(app) + r"-[^-]+\.jsonl")
        self._limit = limit
        self._part = 0
        self._failed = False
        folder.mkdir(parents=True, exist_ok=True)
        self._make_room()

    def write(self, lines: Iterable[dict[str, Any]]) -> None:
        """Append lines; an error of the disk is logged, and ends the recording."""
        if self._failed:
            return
        try:
            with self._file.open("a") as file:
                file.writelines(json.dumps(line) + "\n" for line in lines)
                full = file.tell() >= self._limit // _PARTS
            if full:
                self._part += 1
                self._make_room()
        except OSError:
            logger.exception("shadow: nothing more is written to %s", self._folder)
            self._failed = True

    @property
    def _file(self) -> Path:
        return self._folder / f"{self._stem}{f'.{self._part}' if self._part else ''}.jsonl"

    def _make_room(self) -> None:
        """Delete the oldest files until another part fits in."""
        found = [(path.stat(), path) for path in self._folder.iterdir() if self._own.fullmatch(path.name)]
        total = sum(about.st_size for about, _ in found)
        for about, path in sorted(found, key=lambda one: one[0].st_mtime_ns):
            if total <= self._limit - self._limit // _PARTS:
                break
            path.unlink(missing_ok=True)
            total -= about.st_size


@dataclass(slots=True)
class Compared:
    """The comparisons of one collection interval."""

    outcomes: Counter[str] = field(default_factory=Counter)  # observations: "compared", or "failed" at the candidate
    differences: dict[str, Sample[float]] = field(default_factory=dict)  # means of joints, by rows: "all", "first"
    joints: np.ndarray | None = None  # (D,) sum of the mean absolute differences
    latencies_ms: Sample[float] = field(default_factory=Sample)  # of the candidate


class Comparer:
    """Compares the candidate's replies with those of the live policy. Thread-safe."""

    def __init__(self, log: ComparisonLog | None = None) -> None:
        """Create a comparer that records each comparison in `log`; None records nothing."""
        self._log = log
        self._lock = threading.Lock()
        self._compared = Compared()

    def add(
        self, asked: Sequence[Request], live: Sequence[Reply], replies: Sequence[Reply], dropped: Sequence[int]
    ) -> list[str]:
        """Compare and record the replies to requests of different sessions.

        It may take milliseconds, and writes to a disk. `live` are the replies of the live policy to `asked`, `replies`
        those of the candidate; `dropped` counts the observations before each request, in its episode, that the
        candidate has not got.

        Returns:
            The sessions that the candidate does not know, and cannot follow before their next reset.
        """
        lost, lines = [], []
        for request, ours, theirs, missed in zip(asked, live, replies, dropped, strict=True):
            if theirs.error is not None and (
                request.op == "reset" or isinstance(theirs.error, NotReset | UnknownSession)
            ):
                lost.append(request.session)
            if request.op == "close":
                continue
            line: dict[str, Any] = {"time": time.time(), "session": request.session, "op": request.op}
            if request.op == "reset":
                line |= {"instruction": request.instruction}
                line |= {"live": ours.identity, "candidate": _described(theirs) | theirs.identity}
            else:
                line |= {
                    "step": ours.step,
                    "dropped": missed,
                    "live": _described(ours),
                    "candidate": _described(theirs),
                }
                line["difference"] = self._compare(ours, theirs)
            lines.append(line)
        if self._log is not None:
            self._log.write(lines)
        return lost

    def collect(self) -> Compared:
        """Return the comparisons since the last call."""
        with self._lock:
            compared, self._compared = self._compared, Compared()
        return compared

    def _compare(self, ours: Reply, theirs: Reply) -> dict[str, Any] | None:
        """Count a comparison, and return what is recorded of it; None if the candidate has failed."""
        found: ActionDifference | None = None
        if ours.act is not None and theirs.act is not None:
            try:
                found = action_difference(ours.act.action, theirs.act.action)
            except ValueError as error:
                logger.warning("%s", error)
        with self._lock:
            into = self._compared
            into.outcomes["failed" if found is None else "compared"] += 1
            if found is None:
                return None
            into.differences.setdefault("all", Sample()).add(found.mean)
            into.differences.setdefault("first", Sample()).add(float(found.first_row.mean()))
            known = into.joints if into.joints is not None and into.joints.shape == found.by_joint.shape else 0.0
            into.joints = found.by_joint + known
            into.latencies_ms.add(sum(theirs.timing.get(stage, 0.0) for stage in ("queue_ms", "inference_ms")))
        return {
            "rows": found.rows,
            "mean": found.mean,
            "by_joint": found.by_joint.tolist(),
            "first_row": found.first_row.tolist(),
            "cosine": found.cosine,
        }


def _described(reply: Reply) -> dict[str, Any]:
    """Return what is recorded of a reply."""
    if reply.error is not None:
        return {"error": reply.error.code, "detail": str(reply.error)}
    described: dict[str, Any] = {"timing": reply.timing}
    if isinstance(reply.act, Act):
        described |= {"action": reply.act.action.tolist(), "done": reply.act.done}
        described |= {POLICY: reply.act.info.get(POLICY)}
    return described
