"""Logs each cell to the trackers once, when it is complete, without delaying the evaluation."""

from __future__ import annotations

import logging
import sqlite3
import threading
from contextlib import closing
from pathlib import Path
from typing import Any

from vlagents_ray.evaluate.artifacts.storage import PROVENANCE
from vlagents_ray.evaluate.plan.config import EvalConfig, Tracker, fingerprint
from vlagents_ray.evaluate.results.changes import IDENTITY
from vlagents_ray.evaluate.results.database import FILE, WAIT_S
from vlagents_ray.evaluate.results.reader import CellResults, Results
from vlagents_ray.evaluate.results.summary import Group, summarize
from vlagents_ray.evaluate.trackers.base import About, TrackerRun
from vlagents_ray.registry import named_class, require

log = logging.getLogger(__name__)

CLOSE_S = 120.0  # for trackers to send what is buffered
_RUNS: dict[str, str] = {
    "wandb": "vlagents_ray.evaluate.trackers.wandb:WandbRun",
    "trackio": "vlagents_ray.evaluate.trackers.trackio:TrackioRun",
    "tensorboard": "vlagents_ray.evaluate.trackers.tensorboard:TensorboardRun",
}


class TrackerFeed:
    """Logs to the trackers from a thread, as a tracker may wait for a network. Use as a context manager around a run.

    A tracker that fails is not used again in this run: a warning is logged, and the results are unaffected. What was
    logged is noted in the results, so that a run that resumes them logs only what is new.
    """

    def __init__(self, config: EvalConfig) -> None:
        """Raise `MissingDependency` for a tracker that is not installed."""
        for name in config.track:
            require(name)
        self._config = config
        self._working: list[Tracker] = list(config.track)  # those that have not failed
        self._runs: dict[tuple[str, str], TrackerRun] = {}  # by tracker and policy
        self._updated = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._loop, name="vlagents-ray-trackers", daemon=True)

    def update(self) -> None:
        """Look for complete cells soon. Calls while trackers are busy count as one."""
        self._updated.set()

    def __enter__(self) -> TrackerFeed:
        if self._working:
            self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        if self._config.track:
            self._closing = True
            self._updated.set()
            self._thread.join(CLOSE_S)
            if self._thread.is_alive():
                log.warning("%s: still sending after %g s; given up", ", ".join(self._working), CLOSE_S)

    def _loop(self) -> None:
        over = False
        while not over:
            self._updated.wait()
            self._updated.clear()
            over = self._closing  # read before the results are: whatever is complete by then is logged
            self._log_to_all()
        for (name, _), run in self._runs.items():
            try:
                run.finish()
            except Exception as error:  # noqa: BLE001 - whatever a tracker raises
                log.warning("%s: %s: %s", name, type(error).__name__, error)

    def _log_to_all(self) -> None:
        for name in list(self._working):
            try:
                self._log_to(name, Results.load(self._config.out))
            except Exception as error:  # noqa: BLE001 - whatever a tracker raises
                log.warning("%s: %s: %s; nothing more is logged to it", name, type(error).__name__, error)
                self._working.remove(name)

    def _log_to(self, name: Tracker, results: Results) -> None:
        with closing(sqlite3.connect(self._config.out / FILE, timeout=WAIT_S)) as db:
            logged = dict(db.execute("SELECT what, episodes FROM tracked WHERE tracker = ?", (name,)))
            for part, cells, group in _parts(results):
                if not all(map(_complete, cells)) or logged.get(part) == group.episodes:
                    continue
                run = self._run(name, results, cells[0].policy)
                run.log(_metrics(group), cells[0].step)
                if part == cells[0].cell and (videos := self._videos(cells[0])):
                    run.videos(_label(group), videos, cells[0].step)
                with db:
                    db.execute("INSERT OR REPLACE INTO tracked VALUES (?, ?, ?)", (name, part, group.episodes))

    def _run(self, name: Tracker, results: Results, policy: str) -> TrackerRun:
        if (name, policy) not in self._runs:
            self._runs[name, policy] = named_class(_RUNS[name], {})(self._about(results, policy))
        return self._runs[name, policy]

    def _about(self, results: Results, policy: str) -> About:
        out, names = self._config.out, self._config.tracking
        metadata = results.policies.get(policy, {})
        served = {name: metadata.get(name) for name in IDENTITY}
        code: dict[str, Any] = dict(results.runs[-1].versions.get("code", {}))
        code[f"policy {policy}"] = metadata.get("code")
        code |= {f"env {cell.env}": cell.code for cell in results.cells}
        return About(
            out, names.project, names.group or out.resolve().name, policy,
            fingerprint([results.runs[0].started, policy]),
            {"evaluation": results.runs[-1].config, "served": served, "code": code},
            sorted((out / PROVENANCE).glob("*.diff")),
        )  # fmt: skip

    def _videos(self, cell: CellResults) -> list[Path]:
        ordered = sorted(cell.episodes, key=lambda one: bool(one.result.success_once))
        paths = [self._config.out / path for one in ordered for path in one.videos[:1]]
        return paths[: self._config.tracking.videos]


def _parts(results: Results) -> list[tuple[str, list[CellResults], Group]]:
    """What is logged together, as (the key under which that is noted, cells, aggregates): each cell, each policy id."""
    summary = summarize(results)
    alone = [(cell.cell, [cell], group) for cell, group in zip(results.cells, summary.cells, strict=True)]
    totals = zip(results.contenders, summary.totals, strict=True)
    return alone + [(contender, results.of(contender), group) for contender, group in totals]


def _complete(cell: CellResults) -> bool:
    return cell.stopped_at is not None or sum(not one.beyond for one in cell.episodes) >= cell.planned


def _label(group: Group) -> str:
    return "/".join(filter(None, (group.suite, group.env)))


def _metrics(group: Group) -> dict[str, float]:
    values = {
        "success_once": group.success_once.rate,
        "success_at_end": group.success_at_end.rate,
        "return": group.mean_return,
        "steps": group.mean_steps,
        "episodes": group.episodes,
    }
    return {f"{_label(group)}/{name}": float(value) for name, value in values.items() if value is not None}
