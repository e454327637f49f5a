"""Logging of a running evaluation to trackers, such as wandb. Plug-ins register the trackers."""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from vlagents_ray.evaluate.artifacts.storage import PROVENANCE
from vlagents_ray.evaluate.plan.config import fingerprint
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan
from vlagents_ray.evaluate.results.changes import IDENTITY
from vlagents_ray.evaluate.results.database import FILE, WAIT_S
from vlagents_ray.evaluate.results.reader import CaseResults, Results
from vlagents_ray.evaluate.results.summary import Group, summarize

log = logging.getLogger(__name__)

CLOSE_S = 120.0  # time limit for trackers to send their buffered values, s


@dataclass(frozen=True, slots=True)
class TrackedPolicy:
    """The content of one run in a tracker: one policy in one folder of results, with all its
    checkpoints.
    """

    out: Path
    project: str
    group: str
    name: str  # the name of the policy
    id: str  # id of the tracker's run, reused when an evaluation in this folder is resumed
    # The settings (`evaluation`), the policy's identity (`served`) and the git states (`code`).
    config: dict[str, Any]
    diffs: Sequence[Path]  # files with the uncommitted changes of working trees


class TrackerRun(Protocol):
    """The interface of a run in a tracker. `track` of an evaluation names its class.

    The methods may raise any error; the caller handles it.
    """

    def __init__(self, subject: TrackedPolicy) -> None:
        """Begin the run, or continue an existing run with this id."""

    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        """Log values at a training step. If `step` is None, these are the only values of the
        run.
        """

    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        """Log videos of episodes. `label` consists of suite and env, like the prefix of the names
        of values.
        """

    def finish(self) -> None:
        """Send the buffered values, and end the run."""


class TrackerFeed:
    """Logs to the trackers on a separate thread, since a tracker may wait for a network. Use it as
    a context manager around a run.

    If a tracker fails, a warning is logged and the tracker is not used again in this run; the
    results are unaffected. The database records the values that were logged, so that a resumed run
    logs only new values.
    """

    def __init__(self, plan: ResolvedPlan) -> None:
        """Prepare the trackers of a plan."""
        self._plan = plan
        self._working = list(plan.trackers)  # the trackers that have not failed
        self._runs: dict[tuple[str, str], TrackerRun] = {}  # keys: (tracker, policy)
        self._updated = threading.Event()
        self._closing = False
        self._thread = threading.Thread(
            target=self._loop, name="vlagents-ray-trackers", daemon=True
        )

    def update(self) -> None:
        """Request a check for complete cases. Several calls while trackers are busy cause only one
        check.
        """
        self._updated.set()

    def __enter__(self) -> TrackerFeed:
        if self._working:
            self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        if self._plan.trackers:
            self._closing = True
            self._updated.set()
            self._thread.join(CLOSE_S)
            if self._thread.is_alive():
                log.warning(
                    "%s: still sending after %g s; the remaining values are dropped",
                    ", ".join(self._working),
                    CLOSE_S,
                )

    def _loop(self) -> None:
        over = False
        while not over:
            self._updated.wait()
            self._updated.clear()
            # Read the flag before the results, so that all complete cases are logged.
            over = self._closing
            for tracker in list(self._working):
                try:
                    self._log_to(tracker, Results.load(self._plan.out))
                except Exception as error:  # noqa: BLE001 - whatever a tracker raises
                    log.warning(
                        "%s: %s: %s; nothing more is logged to it",
                        tracker,
                        type(error).__name__,
                        error,
                    )
                    self._working.remove(tracker)
        for (name, _), run in self._runs.items():
            try:
                run.finish()
            except Exception as error:  # noqa: BLE001 - whatever a tracker raises
                log.warning("%s: %s: %s", name, type(error).__name__, error)

    def _log_to(self, name: str, results: Results) -> None:
        """Log the complete cases, and then the complete policies, except for values that the
        tracker already has.
        """
        summary = summarize(results)
        groups = []
        for case, group in zip(results.cases, summary.cases, strict=True):
            groups.append((case.case_id, [case], group))
        for policy, total in zip(results.policy_ids, summary.totals, strict=True):
            groups.append((policy, results.of(policy), total))

        with closing(sqlite3.connect(self._plan.out / FILE, timeout=WAIT_S)) as db:
            logged = dict(
                db.execute("SELECT what, episodes FROM tracked WHERE tracker = ?", (name,))
            )
            for identity, cases, group in groups:
                is_logged = logged.get(identity) == group.episodes
                if is_logged or not all(map(_is_complete, cases)):
                    continue

                run = self._run_of(name, results, cases[0].policy)
                label = "/".join(filter(None, (group.suite, group.env)))
                run.log(_metrics(label, group), cases[0].step)
                if identity == cases[0].case_id:
                    videos = self._videos(cases[0])
                    if videos:
                        run.videos(label, videos, cases[0].step)

                with db:
                    db.execute(
                        "INSERT OR REPLACE INTO tracked VALUES (?, ?, ?)",
                        (name, identity, group.episodes),
                    )

    def _run_of(self, name: str, results: Results, policy: str) -> TrackerRun:
        run = self._runs.get((name, policy))
        if run is None:
            tracker = self._plan.trackers[name]
            run = self._runs[name, policy] = tracker(self._subject(results, policy))
        return run

    def _videos(self, case: CaseResults) -> list[Path]:
        """Return the videos of a case to log, failures first."""
        ordered = sorted(case.episodes, key=lambda episode: bool(episode.result.success_once))
        videos = []
        for episode in ordered:
            if episode.videos:
                videos.append(self._plan.out / episode.videos[0])
        return videos[: self._plan.tracking.videos]

    def _subject(self, results: Results, policy: str) -> TrackedPolicy:
        out, names = self._plan.out, self._plan.tracking
        metadata = results.policies.get(policy, {})
        served = {name: metadata.get(name) for name in IDENTITY}
        code: dict[str, Any] = dict(results.runs[-1].versions.get("code", {}))
        code[f"policy {policy}"] = metadata.get("code")
        code |= {f"env {case.env}": case.code for case in results.cases}
        return TrackedPolicy(
            out, names.project, names.group or out.resolve().name, policy,
            fingerprint([results.runs[0].started, policy]),
            {"evaluation": results.runs[-1].config, "served": served, "code": code},
            sorted((out / PROVENANCE).glob("*.diff")),
        )  # fmt: skip


def _is_complete(case: CaseResults) -> bool:
    if case.stopped_at is not None:
        return True
    return sum(not episode.beyond for episode in case.episodes) >= case.planned


def _metrics(label: str, group: Group) -> dict[str, float]:
    """Return the known values of a group, by the names of their curves."""
    values = {
        "success_once": group.success_once.rate,
        "success_at_end": group.success_at_end.rate,
        "return": group.mean_return,
        "steps": group.mean_steps,
        "episodes": group.episodes,
        "share_in_time": None if group.time_share is None else group.time_share.share,
    }
    return {f"{label}/{name}": float(value) for name, value in values.items() if value is not None}
