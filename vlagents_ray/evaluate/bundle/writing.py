"""Writes a bundle of a folder of results."""

from __future__ import annotations

import json
import sqlite3
import tempfile
from contextlib import closing
from glob import escape
from pathlib import Path

from vlagents_ray.evaluate.artifacts.provenance import versions
from vlagents_ray.evaluate.artifacts.storage import PROVENANCE, inside, link_or_copy, require_below, storing
from vlagents_ray.evaluate.bundle.archive import CONFIG, PACKAGES, pack
from vlagents_ray.evaluate.bundle.packages import pins
from vlagents_ray.evaluate.plan.config import canonical
from vlagents_ray.evaluate.report.html import FILE as REPORT
from vlagents_ray.evaluate.report.html import write_report
from vlagents_ray.evaluate.report.html.provenance import repeat
from vlagents_ray.evaluate.results.database import FILE as DATABASE
from vlagents_ray.evaluate.results.reader import Results, reading
from vlagents_ray.evaluate.results.summary import Summary, summarize, write_summary


def write_bundle(folder: Path, archive: Path, *, videos: bool = False) -> str:
    """Write the results in `folder` as one file that others can check (`verify`).

    It holds results.db as it is now, `summary.json` and `report.html` computed from that, the settings as
    `config.yaml` (one for each folder, of merged results), the versions of all packages here as `packages.txt`, the
    differences from the commits, and the trajectories, with which episodes are played again. The database names the
    files that are in the bundle, so that its results can be merged with others.

    Args:
        folder: A folder of results, which may be written to meanwhile; nothing in it is changed.
        archive: The file.
        videos: Whether the bundle holds the videos, too: of the report, and of what the policy saw.

    Returns:
        The SHA-256 of its manifest, which stands for all that is in it.

    Raises:
        ConfigError: The folder has no results, or one of its files is outside of it.
        StorageFailed: The disk is full, or cannot be written to.
    """
    with storing(archive.parent):
        archive.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f"{archive.name}.part-", dir=archive.parent) as temporary:
            stage = Path(temporary) / "bundle"  # its name is in the page
            stage.mkdir()
            _copy_database(folder, stage)
            results = Results.load(stage)
            _link_files(folder, stage, results, videos=videos)
            _name_what_is_there(stage)
            write_derived(Results.load(stage), videos=videos)
            (stage / PACKAGES).write_text(pins(), encoding="utf-8")
            return pack(stage, archive, versions())


def write_derived(results: Results, *, videos: bool) -> Summary:
    """Write the files that are computed from the database: summary, report and settings; return the summary."""
    summary = summarize(results)
    write_summary(summary)
    for name, text in configurations(summary).items():
        (results.out / name).write_text(text, encoding="utf-8")
    write_report(results, results.out / REPORT, videos="link" if videos else "none")
    return summary


def configurations(summary: Summary) -> dict[str, str]:
    """The settings of the runs as files that `vlagents-ray eval` takes, by their names."""
    texts = [one.yaml + "\n" for one in repeat(summary).runs]
    if len(texts) == 1:
        return {f"{CONFIG}.yaml": texts[0]}
    return {f"{CONFIG}-{number}.yaml": text for number, text in enumerate(texts, 1)}


def _copy_database(folder: Path, stage: Path) -> None:
    """Copy one consistent state of results.db, also while an evaluation writes to it."""
    with reading(folder) as source, closing(sqlite3.connect(stage / DATABASE)) as target:
        source.backup(target)
        target.execute("PRAGMA journal_mode = DELETE")


def _link_files(folder: Path, stage: Path, results: Results, *, videos: bool) -> None:
    paths: list[str] = []
    for cell in results.cells:
        for one in cell.episodes:
            if videos:
                paths += one.videos
            if one.trajectory is not None:
                paths.append(require_below(one.trajectory))
                numbers = folder / one.trajectory
                seen = sorted(numbers.parent.glob(f"{escape(numbers.stem)}_*.mp4")) if videos else []
                paths += [str(path.relative_to(folder)) for path in seen]
    paths += [f"{PROVENANCE}/{path.name}" for path in sorted((folder / PROVENANCE).glob("*.diff"))]
    for path in dict.fromkeys(paths):
        source = inside(folder, path)
        if source.is_file():  # a folder that was copied without its videos can be bundled
            link_or_copy(source, stage / path)


def _name_what_is_there(stage: Path) -> None:
    """Leave out the names of files that the bundle does not have."""
    with closing(sqlite3.connect(stage / DATABASE)) as db, db:
        for key, videos, trajectory in db.execute("SELECT key, videos, trajectory FROM episodes").fetchall():
            there = [path for path in json.loads(videos) if (stage / path).is_file()]
            numbers = trajectory if trajectory is not None and (stage / trajectory).is_file() else None
            db.execute("UPDATE episodes SET videos = ?, trajectory = ? WHERE key = ?", (canonical(there), numbers, key))
