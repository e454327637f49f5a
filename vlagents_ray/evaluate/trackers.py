"""Trackers of evaluations: wandb, trackio, TensorBoard."""

from __future__ import annotations

import json
import logging
import sqlite3
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlagents_ray.evaluate.artifacts.storage import PROVENANCE
from vlagents_ray.evaluate.plan.config import EvalConfig, Tracker, fingerprint
from vlagents_ray.evaluate.results.changes import IDENTITY
from vlagents_ray.evaluate.results.database import FILE, WAIT_S
from vlagents_ray.evaluate.results.reader import Results
from vlagents_ray.evaluate.results.summary import summarize
from vlagents_ray.naming import plain
from vlagents_ray.registry import require

log = logging.getLogger(__name__)

STEP = "training_step"  # wandb's axis of the curves
FOLDER = "tensorboard"  # of its event files, in the folder of results
CLOSE_S = 120.0  # for trackers to send what is buffered


@dataclass(frozen=True, slots=True)
class About:
    """The subject of a tracker's run: one policy of one folder of results, with all its checkpoints."""

    out: Path
    project: str
    group: str
    name: str  # of the policy
    id: str  # is kept when an evaluation resumes this folder
    config: dict[str, Any]  # `evaluation`: its settings; `served`: the policy's identity; `code`: git states
    diffs: Sequence[Path]  # of the working trees from their commits


class WandbRun:
    """A run whose curves are drawn against `training_step`; values without a step are in its summary.

    The methods of a run, in any tracker, may raise anything; the caller handles it.
    """

    def __init__(self, about: About) -> None:
        self._wandb: Any = require("wandb")
        self._id = about.id
        # Code is in the config and in an artifact, as wandb would only read the driver's folder.
        quiet = self._wandb.Settings(silent=True, console="off", disable_git=True, disable_code=True)
        self._run = self._wandb.init(
            project=about.project, group=about.group, name=about.name, id=about.id, dir=str(about.out),
            config=about.config, job_type="eval", resume="allow", reinit="create_new", settings=quiet,
        )  # fmt: skip
        self._run.define_metric(STEP)
        self._run.define_metric("*", step_metric=STEP)
        if about.diffs:
            self._artifact("code", "code", about.diffs)

    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        """Log values at a training step; without a step they are the only values of the run."""
        if step is None:
            self._run.summary.update(dict(metrics))
        else:
            self._run.log({STEP: step, **metrics})

    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        """Upload videos of episodes of the suite and env `label`, the prefix of its values' names."""
        at = "" if step is None else f"-{step}"
        self._artifact(f"videos-{plain(label.replace('/', '_'))}{at}", "videos", paths)

    def finish(self) -> None:
        """Send the buffered values, and end the run."""
        self._run.finish()

    def _artifact(self, name: str, kind: str, paths: Sequence[Path]) -> None:
        artifact = self._wandb.Artifact(f"{self._id}-{name}"[-128:], type=kind)
        for path in paths:
            artifact.add_file(str(path))
        self._run.log_artifact(artifact)


class TrackioRun(WandbRun):
    """A run as in wandb, without a summary and artifacts. Its name has the id, as trackio identifies runs by name."""

    def __init__(self, about: About) -> None:
        self._trackio: Any = require("trackio")
        self._run = self._trackio.init(
            project=about.project, name=f"{about.name}-{about.id[:6]}", group=about.group, config=about.config,
            resume="allow", embed=False, auto_log_gpu=False, auto_log_cpu=False,
        )  # fmt: skip

    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        self._run.log(dict(metrics), step=step or 0)

    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        shown = {f"{label}/{path.stem}": self._trackio.Video(path) for path in paths}
        self._run.log(shown, step=step or 0)


class TensorboardRun:
    """Scalars and texts. TensorBoard plays no MP4, so that the paths of videos are logged."""

    def __init__(self, about: About) -> None:
        self._event: Any = require("tensorboard.compat.proto.event_pb2").Event
        self._summary: Any = require("tensorboard.compat.proto.summary_pb2").Summary
        self._tensor: Any = require("tensorboard.compat.proto.tensor_pb2").TensorProto
        self._text_metadata: Any = require("tensorboard.plugins.text.metadata").create_summary_metadata
        writer = require("tensorboard.summary.writer.event_file_writer").EventFileWriter
        self._writer = writer(str(about.out / FOLDER / plain(about.name)))
        self._out = about.out
        self._text("config", json.dumps(about.config, indent=1, default=str), 0)

    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        values = [self._summary.Value(tag=name, simple_value=value) for name, value in metrics.items()]
        self._add(values, step or 0)

    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        self._text(f"{label}/videos", "\n".join(str(path.relative_to(self._out)) for path in paths), step or 0)

    def finish(self) -> None:
        self._writer.close()

    def _text(self, tag: str, text: str, step: int) -> None:
        indented = "\n".join(f"    {line}" for line in text.splitlines())  # Markdown for preformatted text
        tensor = self._tensor(
            dtype="DT_STRING", string_val=[indented.encode()], tensor_shape={"dim": [{"size": 1}]}
        )  # fmt: skip
        self._add([self._summary.Value(tag=tag, metadata=self._text_metadata(tag, ""), tensor=tensor)], step)

    def _add(self, values: Sequence[Any], step: int) -> None:
        event = self._event(step=step, wall_time=time.time(), summary=self._summary(value=values))
        self._writer.add_event(event)
        self._writer.flush()


TrackerRun = WandbRun | TensorboardRun
_RUNS: dict[str, type[TrackerRun]] = {"wandb": WandbRun, "trackio": TrackioRun, "tensorboard": TensorboardRun}


class TrackerFeed:
    """Logs to the trackers from a thread, as a tracker may wait for a network. Use as a context manager around a run.

    A tracker that fails is not used again in this run: a warning is logged, and the results are unaffected. The results
    record what was logged, so that a resumed run logs only new values.
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
        """Request a check for complete cells. Calls while trackers are busy count as one."""
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
            over = self._closing  # read before the results, so that all cells complete by then are logged
            for tracker in list(self._working):
                try:
                    self._log_to(tracker, Results.load(self._config.out))
                except Exception as error:  # noqa: BLE001 - whatever a tracker raises
                    log.warning("%s: %s: %s; nothing more is logged to it", tracker, type(error).__name__, error)
                    self._working.remove(tracker)
        for (name, _), run in self._runs.items():
            try:
                run.finish()
            except Exception as error:  # noqa: BLE001 - whatever a tracker raises
                log.warning("%s: %s: %s", name, type(error).__name__, error)

    def _log_to(self, name: Tracker, results: Results) -> None:
        with closing(sqlite3.connect(self._config.out / FILE, timeout=WAIT_S)) as db:
            logged = dict(db.execute("SELECT what, episodes FROM tracked WHERE tracker = ?", (name,)))
            summary, policies = summarize(results), results.contenders
            parts = [(one.cell, [one], group) for one, group in zip(results.cells, summary.cells, strict=True)]
            parts += [(one, results.of(one), group) for one, group in zip(policies, summary.totals, strict=True)]
            for part, cells, group in parts:  # each cell, then each policy id
                over = all(
                    cell.stopped_at is not None or sum(not one.beyond for one in cell.episodes) >= cell.planned
                    for cell in cells
                )
                if not over or logged.get(part) == group.episodes:
                    continue
                policy = cells[0].policy
                if (run := self._runs.get((name, policy))) is None:
                    run = self._runs[name, policy] = _RUNS[name](self._about(results, policy))
                rates = {"success_once": group.success_once.rate, "success_at_end": group.success_at_end.rate}
                values = rates | {"return": group.mean_return, "steps": group.mean_steps, "episodes": group.episodes}
                label = "/".join(filter(None, (group.suite, group.env)))
                run.log({f"{label}/{k}": float(v) for k, v in values.items() if v is not None}, cells[0].step)
                ordered = sorted(cells[0].episodes, key=lambda one: bool(one.result.success_once))
                paths = [self._config.out / path for one in ordered for path in one.videos[:1]]
                if part == cells[0].cell and (videos := paths[: self._config.tracking.videos]):
                    run.videos(label, videos, cells[0].step)
                with db:
                    db.execute("INSERT OR REPLACE INTO tracked VALUES (?, ?, ?)", (name, part, group.episodes))

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
