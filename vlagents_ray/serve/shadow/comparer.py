"""The side of the candidate: its actions beside those of the live policy, counted and recorded."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.errors import NotReset, UnknownSession
from vlagents_ray.interface import POLICY, Act
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.metrics_buffer import Sample
from vlagents_ray.serve.shadow.comparison import ActionDifference, action_difference
from vlagents_ray.serve.shadow.comparison_log import ComparisonLog

logger = logging.getLogger(__name__)


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

        It may take milliseconds, and writes to a disk.

        Args:
            asked: The requests.
            live: The replies of the live policy.
            replies: Those of the candidate.
            dropped: The number of observations before each request, in its episode, that the candidate has not got.

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
                line["difference"] = self._compare(request, ours, theirs)
            lines.append(line)
        if self._log is not None:
            self._log.write(lines)
        return lost

    def collect(self) -> Compared:
        """Return the comparisons since the last call."""
        with self._lock:
            compared, self._compared = self._compared, Compared()
        return compared

    def _compare(self, request: Request, ours: Reply, theirs: Reply) -> dict[str, Any] | None:
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
