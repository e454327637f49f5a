"""Checks a bundle: its digests, its tables, its recordings, the software, and some of its episodes by playing them."""

from __future__ import annotations

import os
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.evaluate.artifacts.storage import storing
from vlagents_ray.evaluate.bundle.archive import CONFIG, MOST_BYTES, PACKAGES, Manifest, unpack, write_derived
from vlagents_ray.evaluate.bundle.checks import (
    Finding,
    check_cells,
    check_derived,
    check_digests,
    check_packages,
    check_trajectories,
    check_versions,
    check_weights,
    same_software,
)
from vlagents_ray.evaluate.bundle.replaying import check_replays
from vlagents_ray.evaluate.report.page import FILE as REPORT
from vlagents_ray.evaluate.results.database import FILE as DATABASE
from vlagents_ray.evaluate.results.reader import Results
from vlagents_ray.evaluate.results.summary import FILE as SUMMARY

_MOST_DERIVED = 2**28  # bytes of a summary, a report, settings or a lock


@dataclass(frozen=True, slots=True)
class Verification:
    """What was found of a bundle."""

    digest: str  # SHA-256 of the bundle's manifest, which stands for all that is in it
    findings: list[Finding]

    @property
    def holds(self) -> bool:
        """Whether nothing contradicts the bundle."""
        return all(one.verdict != "differs" for one in self.findings)


def verify(
    bundle: Path, *, into: Path | None = None, replay: int = 3, trust: bool = False, most_bytes: int = MOST_BYTES
) -> Verification:
    """Check a bundle, which may come from a stranger.

    None of its text is run, imported or unpickled. Its environments are only made if they are registered here, and
    with options that are numbers and words, unless `trust` is set.

    Args:
        bundle: The file.
        into: A new folder for its results, which then can be read, merged and exported as any others; None: they are
            removed again. Summary, report and settings there are written from the database, not taken from the bundle.
        replay: The number of episodes whose recorded actions are played again.
        trust: Whether its environments are made whatever code and files they name.
        most_bytes: The most bytes that its files may have together.

    Returns:
        The findings.

    Raises:
        ConfigError: The file is no bundle, is larger than allowed, or its database cannot be read; or `into` is there.
        StorageFailed: The disk is full, or cannot be written to.
    """
    if into is not None and into.exists():
        raise ConfigError(f"{into}: is there already; want a new folder")
    parent = None if into is None else into.absolute().parent
    with storing(parent or Path(tempfile.gettempdir())):
        if parent is not None:
            parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="bundle.part-", dir=parent) as temporary:
            folder = Path(temporary) / "bundle"  # its name is in the page
            folder.mkdir()
            manifest, digest, odd = unpack(bundle, folder, most_bytes=most_bytes)
            findings = [check_digests(odd, len(manifest.files))]
            try:
                findings += _check(folder, manifest, replay, trust=trust)
            except (VLAgentsError, sqlite3.Error):
                raise
            except (ArithmeticError, LookupError, RecursionError, TypeError, ValueError, AttributeError) as error:
                raise ConfigError(
                    f"{bundle}: its database holds values that no evaluation writes ({type(error).__name__}: {error}); "
                    f"do not trust whoever made it"
                ) from error
            if into is not None:
                os.replace(folder, into)
    return Verification(digest, findings)


def _check(folder: Path, manifest: Manifest, replay: int, *, trust: bool) -> Iterator[Finding]:
    """All findings but that of the digests; the files that the database gives are written again on the way."""
    if not (folder / DATABASE).is_file():
        raise ConfigError(f"got no {DATABASE} in the bundle; want one that `vlagents-ray bundle` wrote")
    stated = _take_derived(folder)
    results = Results.load(folder)
    if not results.runs or not results.cells:
        raise ConfigError(f"{DATABASE}: has no run, or no cell; want the results of an evaluation")
    lock = stated.pop(PACKAGES, b"").decode("utf-8", "replace")
    yield check_cells(results)
    write_derived(results, videos=any(name.endswith(".mp4") for name in manifest.files))
    yield from check_derived(stated, folder, same_software=same_software(manifest.written_by))
    yield check_trajectories(results)
    yield from check_versions(results)
    yield from check_packages(lock, results)
    yield from check_weights(results)
    yield from check_replays(results, replay, trust=trust)
    (folder / PACKAGES).write_text(lock, encoding="utf-8")


def _take_derived(folder: Path) -> dict[str, bytes]:
    """Read the files that can be written again, and remove them: a stranger's page is not left for a browser."""
    found = {}
    for path in [folder / SUMMARY, folder / REPORT, folder / PACKAGES, *sorted(folder.glob(f"{CONFIG}*.yaml"))]:
        if path.is_file():
            if path.stat().st_size > _MOST_DERIVED:
                raise ConfigError(f"{path.name}: has {path.stat().st_size} bytes, want at most {_MOST_DERIVED}")
            found[path.name] = path.read_bytes()
            path.unlink()
    return found
