"""Checks a bundle: its digests, its tables, its recordings, the software, and some of its episodes by playing them.

A replay plays the recorded actions in their environment, and compares. No policy is needed.
"""

from __future__ import annotations

import os
import re
import sqlite3
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.envs.base import make_batch
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.evaluate.artifacts.storage import storing
from vlagents_ray.evaluate.artifacts.trajectory import Trajectory
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
    recorded,
    same_software,
)
from vlagents_ray.evaluate.episode.episode import options_of_reset
from vlagents_ray.evaluate.episode.failures import env_side
from vlagents_ray.evaluate.episode.second_pass import play_actions
from vlagents_ray.evaluate.report.page import FILE as REPORT
from vlagents_ray.evaluate.results.database import FILE as DATABASE
from vlagents_ray.evaluate.results.reader import CellResults, Episode, Results
from vlagents_ray.evaluate.results.summary import FILE as SUMMARY
from vlagents_ray.interface import Obs
from vlagents_ray.registry import env_suite, names

_MOST_DERIVED = 2**28  # bytes of a summary, a report, settings or a lock


@dataclass(frozen=True, slots=True)
class Verification:
    """The findings on a bundle."""

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


_CODE = re.compile("trust.*|module|source_dir")  # options that say whose code is run, though they may be words
_WORD = re.compile(r"\w[\w.+-]{0,63}")  # a value that is text, and no path, URL or "module:Class"
_SHOWN = 80  # characters of a value


@dataclass(frozen=True, slots=True)
class Replayed:
    """The outcome of the recorded actions."""

    steps: int
    outcome: tuple[bool, bool, int | None]  # success once, success at the end, steps after which it was first solved
    differs_from: int | None  # the first step whose state, reward or success is another; 0 is the reset
    largest: float  # difference of a number of the state or of a reward
    described: Mapping[str, Any]  # by the environment here

    @property
    def same(self) -> bool:
        """Whether every number is the same to the bit."""
        return self.differs_from is None


def require_harmless(cell: CellResults) -> None:
    """Raise `ConfigError` unless making this environment runs no code but that of a registered one.

    A bundle may come from a stranger: "module:Class" would be imported, and an option that is a path or a nested value
    could name files or code of this machine. `trust_remote_code` from a bundle is refused: only the local user
    can grant it.
    """
    if env_suite(cell.env) not in names("envs") or ":" in cell.env:
        raise ConfigError(f"{cell.env}: is no registered environment; --trust makes it, and runs its code")
    for kind in ("env_options", "reset_options"):
        stated = cell.settings.get(kind) or {}
        odd = {name: value for name, value in stated.items() if _CODE.fullmatch(name) or not _is_plain(value)}
        if odd:
            raise ConfigError(f"{cell.env}: got the {kind} {odd}, which could name files or code; --trust takes them")


def replay_actions(cell: CellResults, episode: Episode, trajectory: Trajectory) -> Replayed:
    """Play the actions of `trajectory` in the environment of `cell`, from the episode's seed on.

    Images are neither rendered nor compared. State, gripper, rewards and success are, bit by bit.

    Raises:
        ConfigError: The environment does not take these options, or is unknown here; also `MissingDependency`.
        EnvFailed: The simulator failed.
    """
    key = episode.result.key
    with env_side("make"):
        env = make_batch(cell.env, 1, **(cell.settings.get("env_options") or {}))
    try:
        with env_side("reset"):
            begin = options_of_reset(env, key.episode, cell.settings.get("reset_options"))
        compared = _Comparison(trajectory)
        played = play_actions(env, key.seed, begin, trajectory.actions, images=False)
        for number, (obs, step) in enumerate(played):
            compared.add(number, obs)
            if step is not None:
                compared.add_outcome(number, step.reward, step.success)
        with env_side("describe"):
            return compared.result(env.describe())
    finally:
        with env_side("close"):
            env.close()


class _Comparison:
    """Compares what the environment gives with a recording, step by step."""

    def __init__(self, recorded: Trajectory) -> None:
        self._recorded = recorded
        self._from: int | None = None
        self._largest = 0.0
        self._success: list[bool] = []

    def add(self, number: int, obs: Obs) -> None:
        now = {part: np.asarray(values, np.float32) for part, values in obs.state.items()}
        if now.keys() != self._recorded.state.keys() or (obs.gripper is None) != (self._recorded.gripper is None):
            self._differ(number, float("inf"))
            return
        pairs = [(self._recorded.state[part][number], values) for part, values in now.items()]
        if self._recorded.gripper is not None:
            pairs.append((self._recorded.gripper[number], np.asarray(obs.gripper, np.float32)))
        for before, values in pairs:
            self._compare(number, np.asarray(before), np.asarray(values))

    def add_outcome(self, number: int, reward: float, success: bool) -> None:
        self._success.append(success)
        self._compare(number, self._recorded.rewards[number - 1], np.float64(reward))
        if bool(self._recorded.success[number - 1]) != success:
            self._differ(number, 0.0)

    def result(self, described: Mapping[str, Any]) -> Replayed:
        first = next((number for number, success in enumerate(self._success, 1) if success), None)
        outcome = (first is not None, bool(self._success and self._success[-1]), first)
        return Replayed(len(self._success), outcome, self._from, self._largest, described)

    def _compare(self, number: int, before: Any, now: Any) -> None:
        if before.shape != now.shape:
            self._differ(number, float("inf"))
        elif before.tobytes() != now.tobytes():
            self._differ(number, float(np.max(np.abs(np.asarray(before, np.float64) - np.asarray(now, np.float64)))))

    def _differ(self, number: int, by: float) -> None:
        self._from = number if self._from is None else self._from
        self._largest = max(self._largest, by)


def _is_plain(value: object) -> bool:
    if isinstance(value, list):
        return all(_is_plain(one) for one in value)
    if isinstance(value, str):
        return _WORD.fullmatch(value) is not None
    return value is None or isinstance(value, bool | int | float)


def check_replays(results: Results, most: int, *, trust: bool) -> Iterator[Finding]:
    """Play the recorded actions of up to `most` episodes, of as many cells as possible."""
    if not most:
        yield Finding("replay", "not checked", "was not asked for (--replay 0)")
        return
    chosen = _chosen(results, most)
    if not chosen:
        yield Finding("replay", "not checked", "no finished episode has a recording (eval --record all)")
    for cell, episode, trajectory in chosen:
        yield _replay(cell, episode, trajectory, trust=trust)


def _chosen(results: Results, most: int) -> list[tuple[CellResults, Episode, Trajectory]]:
    """The first episode with a recording of each cell in turns, then the second of each, and so on."""
    left = [
        (cell, iter([one for one in cell.episodes if one.result.status == "done" and one.trajectory is not None]))
        for cell in results.cells
    ]
    found: list[tuple[CellResults, Episode, Trajectory]] = []
    while left and len(found) < most:
        for pair in list(left):
            cell, episodes = pair
            one = next(episodes, None)
            if one is None:
                left.remove(pair)
            elif len(found) < most and (trajectory := recorded(results, one)) is not None:
                found.append((cell, one, trajectory))
    return found


def _replay(cell: CellResults, episode: Episode, trajectory: Trajectory, *, trust: bool) -> Finding:
    subject = f"replay of {cell.env}#{episode.result.key.episode}@{episode.result.key.seed}"
    if cell.settings.get("robot") is not None:
        return Finding(subject, "not checked", "it was played on a real robot")
    try:
        if not trust:
            require_harmless(cell)
        played = replay_actions(cell, episode, trajectory)
    except VLAgentsError as error:
        return Finding(subject, "not checked", str(error))
    result = episode.result
    if played.outcome != (result.success_once, result.success_at_end, result.first_success):
        now, then = ("solved" if solved else "not solved" for solved in (played.outcome[0], result.success_once))
        return Finding(subject, "differs", f"{now} here, {then} there; {_from(played)}")
    detail = f"{played.steps} actions, every state, reward and success to the bit"
    if not played.same:
        detail = f"the same outcome, other numbers; {_from(played)}"
    if odd := _described(cell.described, played.described):
        detail += f"; the environment says of itself here: {odd}"
    return Finding(subject, "equal" if played.same else "other here", detail)


def _from(played: Replayed) -> str:
    return f"the numbers differ from step {played.differs_from} of {played.steps} on, by at most {played.largest:.3g}"


def _described(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    odd = [
        f"{name} {str(here.get(name))[:_SHOWN]}, there {str(there.get(name))[:_SHOWN]}"
        for name in sorted(there.keys() | here.keys())
        if there.get(name) != here.get(name)
    ]
    return "; ".join(odd)
