"""Whether the files of a bundle say the same, and whether the software and weights here are those of the bundle."""

from __future__ import annotations

import hashlib
import json
import math
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.storage import versions
from vlagents_ray.evaluate.artifacts.trajectory import Trajectory
from vlagents_ray.evaluate.bundle.archive import CONFIG, MANIFEST, compared, pins, versions_of
from vlagents_ray.evaluate.plan.config import fingerprint
from vlagents_ray.evaluate.report.page import FILE as REPORT
from vlagents_ray.evaluate.results.reader import Episode, Results, reading, table
from vlagents_ray.evaluate.results.summary import FILE as SUMMARY
from vlagents_ray.evaluate.results.summary import checkpoint_of, pushed_of, weights_of

Verdict = Literal["equal", "differs", "other here", "not checked"]
MOST_TRAJECTORY = 2**30  # bytes of one, unpacked
_TOLERANCE = 1e-9  # relative: sums of floating-point numbers may differ in their last bits
_SHOWN = 3  # differences in a finding
_RUN_PACKAGES = ("vlagents-ray", "ray", "numpy", "av")  # those that `versions` names
_PACKAGES_SHOWN = 8


@dataclass(frozen=True, slots=True)
class Finding:
    """One check.

    "differs" means that the bundle contradicts itself, or that a replay had another outcome; "other here" that software
    or numbers here are not those there, which alone is no fault of the bundle.
    """

    subject: str
    verdict: Verdict
    detail: str


def check_cells(results: Results) -> Finding:
    """Check that the cells and the keys of their episodes are those of their settings."""
    odd = []
    for cell in results.cells:
        settings = cell.settings
        if fingerprint(settings) != cell.cell or (settings.get("env"), settings.get("policy")) != (
            cell.env,
            cell.policy,
        ):
            odd.append(f"{cell.contender} in {cell.task}: its settings are not those of its key")
        odd += [
            f"{one.result.key}: is of another cell or env" for one in cell.episodes if one.result.key.env != cell.env
        ]
    stated = {str(one.result.key) for cell in results.cells for one in cell.episodes}
    with reading(results.out) as db:
        keys = {row["key"] for row in table(db, "episodes")}
    odd += [f"{key}: its key does not match its columns, or it has no cell" for key in sorted(keys - stated)]
    return _finding("database", odd, f"{len(results.cells)} cells and {len(keys)} episodes have their settings' keys")


def check_derived(stated: dict[str, bytes], computed: Path, *, same_software: bool) -> Iterator[Finding]:
    """Compare the summary, the report and the settings of the bundle with those computed from its database here."""
    yield _check_summary(stated.get(SUMMARY), (computed / SUMMARY).read_bytes())
    if REPORT not in stated:
        yield Finding(REPORT, "differs", "is not in the bundle")
    elif stated[REPORT] == (computed / REPORT).read_bytes():
        yield Finding(REPORT, "equal", "byte for byte what the database gives here")
    elif same_software:
        yield Finding(REPORT, "differs", "the database gives another page with the same software")
    else:
        yield Finding(REPORT, "not checked", "written by other software, whose page differs; --into writes it again")
    settings = {name for name in stated if name.endswith(".yaml")} | {path.name for path in computed.glob("*.yaml")}
    for name in sorted(name for name in settings if name.startswith(CONFIG)):
        mine = computed / name
        same = mine.is_file() and stated.get(name) == mine.read_bytes()
        if same:
            yield Finding(name, "equal", "the settings in the database")
        else:
            verdict: Verdict = "differs" if same_software else "not checked"
            yield Finding(name, verdict, "is not what the database gives here")


def _check_summary(stated: bytes | None, computed: bytes) -> Finding:
    """Compare all that the bundle's summary says; what only this version of the software says is left out."""
    if stated is None:
        return Finding(SUMMARY, "differs", "is not in the bundle")
    try:
        there = json.loads(stated)
    except ValueError as error:
        return Finding(SUMMARY, "differs", f"is no JSON ({error})")
    odd = list(_differences(there, json.loads(computed), ""))
    return _finding(SUMMARY, odd, "every rate, interval and setting is what the database gives")


def _differences(there: Any, here: Any, where: str) -> Iterator[str]:
    if isinstance(there, dict) and isinstance(here, dict):
        for name, value in there.items():
            if name not in here:
                yield f"{where}{name}: the database gives none"
            else:
                yield from _differences(value, here[name], f"{where}{name}.")
    elif isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        for number, (one, other) in enumerate(zip(there, here, strict=True)):
            yield from _differences(one, other, f"{where}{number}.")
    elif isinstance(there, float) and isinstance(here, float):
        if not math.isclose(there, here, rel_tol=_TOLERANCE):
            yield f"{where.rstrip('.')}: {there!r}, the database gives {here!r}"
    elif there != here or type(there) is not type(here):
        yield f"{where.rstrip('.')}: {str(there)[:80]}, the database gives {str(here)[:80]}"


def check_trajectories(results: Results) -> Finding:
    """Check that each recording has the actions, steps, rewards and success that the table says of its episode."""
    odd: list[str] = []
    checked, missing = 0, 0
    for cell in results.cells:
        for one in cell.episodes:
            if one.result.status != "done":
                continue
            if (trajectory := recorded(results, one)) is None:
                missing += 1
                continue
            checked += 1
            odd += [f"{one.result.key}: {text}" for text in _contradictions(one, trajectory)]
    if not checked and not odd:
        return Finding("trajectories", "not checked", f"the bundle has none of {missing} episodes (eval --record all)")
    rest = f"; {missing} others have none" if missing else ""
    return _finding("trajectories", odd, f"{checked} have the actions, rewards and outcomes of the table{rest}")


def recorded(results: Results, episode: Episode) -> Trajectory | None:
    """The recording of an episode; None if the bundle has none. Raises `ConfigError` if it cannot be read."""
    if episode.trajectory is None or not (path := results.file(episode.trajectory)).is_file():
        return None
    try:
        with zipfile.ZipFile(path) as file:
            size = sum(member.file_size for member in file.infolist())
    except (OSError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{episode.trajectory}: cannot be read as a trajectory ({error})") from error
    if size > MOST_TRAJECTORY:
        raise ConfigError(f"{episode.trajectory}: unpacks to {size} bytes, want at most {MOST_TRAJECTORY}")
    try:
        return Trajectory.load(path)
    except MemoryError as error:  # its header states a size that it does not have
        raise ConfigError(f"{episode.trajectory}: states a size that does not fit into memory") from error


def _contradictions(episode: Episode, trajectory: Trajectory) -> Iterator[str]:
    result, steps = episode.result, len(trajectory.actions)
    shapes = [trajectory.rewards.shape == (steps,), trajectory.success.shape == (steps,)]
    shapes += [len(values) == steps + 1 for values in trajectory.state.values()]
    shapes += [] if trajectory.gripper is None else [trajectory.gripper.shape == (steps + 1,)]
    if not all(shapes) or result.steps != steps:
        yield f"{result.steps} steps in the table, other lengths in the recording"
        return
    if hashlib.sha256(np.ascontiguousarray(trajectory.actions, "<f4").tobytes()).hexdigest() != result.actions_sha256:
        yield "the recorded actions are not those of the table's digest"
    if not math.isclose(
        float(sum(trajectory.rewards.tolist())), result.episode_return, rel_tol=_TOLERANCE, abs_tol=1e-12
    ):
        yield "the recorded rewards have another sum"
    success = trajectory.success.astype(bool).tolist()
    first = next((number for number, solved in enumerate(success, 1) if solved), None)
    if (first, bool(success and success[-1])) != (result.first_success, result.success_at_end):
        yield "the recorded success is not that of the table"


def _finding(subject: str, odd: list[str], fine: str) -> Finding:
    if not odd:
        return Finding(subject, "equal", fine)
    more = f"; and {len(odd) - _SHOWN} more" if len(odd) > _SHOWN else ""
    return Finding(subject, "differs", "; ".join(odd[:_SHOWN]) + more)


def check_digests(odd: list[str], number: int) -> Finding:
    return _finding("digests", odd, f"{number} files have the SHA-256 that {MANIFEST} states")


def same_software(written_by: dict[str, Any]) -> bool:
    """Whether the versions that wrote a bundle are those here: Python, packages and code."""
    here = versions()
    return all(_plain(written_by.get(name)) == _plain(here[name]) for name in ("python", *_RUN_PACKAGES)) and (
        _commit(written_by) == _commit(here)
    )


def check_versions(results: Results) -> Iterator[Finding]:
    """Compare what the last run was made with to what is here."""
    there, here = results.runs[-1].versions, versions()
    odd = [
        f"{name} {there.get(name)} there, {here[name]} here"
        for name in ("python", "platform", *_RUN_PACKAGES)
        if there.get(name) != here[name]
    ]
    if odd:
        yield Finding("versions", "other here", "; ".join(odd))
    else:
        yield Finding("versions", "equal", f"Python {here['python']}, {', '.join(_RUN_PACKAGES)} and the platform")
    was, now = _commit(there), _commit(here)
    if was[0] is None or now[0] is None:
        where = "there" if was[0] is None else "here"
        yield Finding("code", "not checked", f"vlagents-ray has no git commit {where}: it is an installed package")
    elif was == now:
        yield Finding("code", "equal", f"vlagents-ray at commit {was[0]}")
    else:
        yield Finding("code", "other here", f"vlagents-ray at commit {_text(was)} there, {_text(now)} here")


def check_packages(lock: str, results: Results) -> Iterator[Finding]:
    """Compare the bundle's lock with the run that it is to be the lock of, and with the packages here."""
    there = versions_of(lock)
    run = {name: results.runs[-1].versions.get(name) for name in _RUN_PACKAGES}
    strange = [
        f"{name} {there[name]} in the lock, {run[name]} in the run"
        for name in _RUN_PACKAGES
        if name in there and run[name] not in (None, there[name])
    ]
    if strange:
        yield Finding("packages.txt", "other here", f"of another environment than the run's: {'; '.join(strange)}")
    same, odd = compared(there, versions_of(pins()))
    if odd:
        more = f"; and {len(odd) - _PACKAGES_SHOWN} more" if len(odd) > _SHOWN else ""
        yield Finding(
            "packages", "other here", f"{same} of {len(there)} are here; {'; '.join(odd[:_PACKAGES_SHOWN])}{more}"
        )
    else:
        yield Finding("packages", "equal", f"all {len(there)} are here in these versions")


def check_weights(results: Results) -> Iterator[Finding]:
    """Say which weights the episodes were played by: a bundle holds none, so that nothing is checked."""
    for contender in results.contenders:
        cells = results.of(contender)
        named = [one for cell in cells for one in (checkpoint_of(cell), weights_of(cell), pushed_of(cell)) if one]
        said = ", ".join(dict.fromkeys(named)) or "no server reported any"
        yield Finding(f"weights of {contender}", "not checked", f"{said}; a bundle holds no weights")


def _commit(found: dict[str, Any]) -> tuple[str | None, str | None]:
    code = found.get("code")
    state = code.get("vlagents_ray") if isinstance(code, dict) else None
    return (state.get("commit"), state.get("diff_sha256")) if isinstance(state, dict) else (None, None)


def _text(commit: tuple[str | None, str | None]) -> str:
    return f"{commit[0]} with changes" if commit[1] else f"{commit[0]}"


def _plain(version: object) -> str:
    return re.sub(r"\s+", "", str(version))
