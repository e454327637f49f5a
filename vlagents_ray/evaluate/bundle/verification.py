"""Verification of a bundle: digests, tables, recordings, software, and some episodes by playing them.

A replay plays the recorded actions in their environment, and compares. No policy is needed.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
import sqlite3
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vlagents_ray.envs.base import make_batch
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.evaluate.artifacts.storage import storing, versions
from vlagents_ray.evaluate.bundle.archive import MANIFEST, MOST_BYTES, unpack
from vlagents_ray.evaluate.episode.episode import options_of_reset
from vlagents_ray.evaluate.episode.failures import env_side
from vlagents_ray.evaluate.episode.second_pass import play_actions
from vlagents_ray.evaluate.plan.config import fingerprint
from vlagents_ray.evaluate.report.page import FILE as REPORT
from vlagents_ray.evaluate.report.page import write_report
from vlagents_ray.evaluate.results.database import FILE as DATABASE
from vlagents_ray.evaluate.results.reader import CellResults, Episode, Results, reading, table
from vlagents_ray.evaluate.results.summary import summarize, write_summary
from vlagents_ray.interface import Obs
from vlagents_ray.registry import env_suite, names

Verdict = Literal["equal", "differs", "other here", "not checked"]
MOST_TRAJECTORY = 2**30  # bytes of one, unpacked
_TOLERANCE = 1e-9  # relative: sums of floating-point numbers may differ in their last bits
_SHOWN = 3  # differences in a finding
_LENGTH = 80  # characters of a value in a finding
_SOFTWARE = ("python", "platform", "vlagents-ray", "ray", "numpy", "av")  # keys of `versions`


@dataclass(frozen=True, slots=True)
class Finding:
    """One check.

    "differs" means that the bundle contradicts itself, or that a replay had another outcome; "other here" means other
    software or numbers here, which alone is no fault of the bundle.
    """

    subject: str
    verdict: Verdict
    detail: str


@dataclass(frozen=True, slots=True)
class Verification:
    """The findings on a bundle."""

    digest: str  # SHA-256 of the bundle's manifest, which identifies its content
    findings: list[Finding]

    @property
    def holds(self) -> bool:
        """Whether nothing contradicts the bundle."""
        return all(one.verdict != "differs" for one in self.findings)


def verify(
    bundle: Path, *, into: Path | None = None, replay: int = 3, trust: bool = False, most_bytes: int = MOST_BYTES
) -> Verification:
    """Check a bundle, which may come from a stranger.

    None of its text is run, imported or unpickled. Its environments are only made if they are registered here and their
    options are numbers and words, unless `trust` is set.

    Args:
        bundle: The file.
        into: A new folder for its results, which can be read, merged and exported as any others; None: they are
            removed. Summary and report in it are written from the database.
        replay: The number of episodes whose recorded actions are played again.
        trust: Whether its environments may name any code and files.
        most_bytes: The most bytes that its files may have together.

    Returns:
        The findings.

    Raises:
        ConfigError: The file is no bundle, is larger than allowed, or its database cannot be read; or `into` exists.
        StorageFailed: The disk is full, or cannot be written to.
    """
    if into is not None and into.exists():
        raise ConfigError(f"{into}: is there already; want a new folder")
    parent = None if into is None else into.absolute().parent
    with storing(parent or Path(tempfile.gettempdir())):
        if parent is not None:
            parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="bundle.part-", dir=parent) as temporary:
            folder = Path(temporary) / (into or bundle).name  # the name is in the report
            folder.mkdir()
            manifest, digest, odd = unpack(bundle, folder, most_bytes=most_bytes)
            fine = f"{len(manifest.files)} files have the SHA-256 that {MANIFEST} states"
            findings = [_finding("digests", odd, fine)]
            try:
                findings += _check(folder, replay, trust=trust)
            except (VLAgentsError, sqlite3.Error):
                raise
            except (ArithmeticError, LookupError, RecursionError, TypeError, ValueError, AttributeError) as error:
                raise ConfigError(
                    f"{bundle}: its database holds values that no evaluation writes ({type(error).__name__}: {error}); "
                    f"do not trust its author"
                ) from error
            if into is not None:
                os.replace(folder, into)
    return Verification(digest, findings)


def _check(folder: Path, replay: int, *, trust: bool) -> Iterator[Finding]:
    """Yield all findings except that of the digests; also write summary and report."""
    if not (folder / DATABASE).is_file():
        raise ConfigError(f"got no {DATABASE} in the bundle; want one that `vlagents-ray bundle` wrote")
    results = Results.load(folder)
    if not results.runs or not results.cells:
        raise ConfigError(f"{DATABASE}: has no run, or no cell; want the results of an evaluation")
    yield _check_cells(results)
    write_summary(summarize(results))
    write_report(results, folder / REPORT)
    yield _check_trajectories(results)
    yield _check_versions(results)
    yield from _check_replays(results, replay, trust=trust)


def _check_cells(results: Results) -> Finding:
    """Check that the cells and the keys of their episodes are those of their settings."""
    odd = []
    for cell in results.cells:
        named = cell.settings.get("env"), cell.settings.get("policy")
        if fingerprint(cell.settings) != cell.cell or named != (cell.env, cell.policy):
            odd.append(f"{cell.contender} in {cell.task}: its settings are not those of its key")
        found = [one.result.key for one in cell.episodes]
        odd += [f"{key}: is of another cell or env" for key in found if key.env != cell.env]
    stated = {str(one.result.key) for cell in results.cells for one in cell.episodes}
    with reading(results.out) as db:
        keys = {row["key"] for row in table(db, "episodes")}
    odd += [f"{key}: its key does not match its columns, or it has no cell" for key in sorted(keys - stated)]
    return _finding("database", odd, f"{len(results.cells)} cells and {len(keys)} episodes have their settings' keys")


def _check_trajectories(results: Results) -> Finding:
    """Check that each recording has the actions, steps, rewards and success of its episode in the table."""
    odd: list[str] = []
    checked, missing = 0, 0
    for cell in results.cells:
        for one in cell.episodes:
            if one.result.status != "done":
                continue
            if (trajectory := _recorded(results, one)) is None:
                missing += 1
                continue
            checked += 1
            odd += [f"{one.result.key}: {text}" for text in _contradictions(one, trajectory)]
    if not checked and not odd:
        return Finding("trajectories", "not checked", f"the bundle has none of {missing} episodes (eval --record all)")
    rest = f"; {missing} others have none" if missing else ""
    return _finding("trajectories", odd, f"{checked} have the actions, rewards and outcomes of the table{rest}")


def _recorded(results: Results, episode: Episode) -> Trajectory | None:
    """Return the recording of an episode; None if the bundle has none. Raises `ConfigError` if it cannot be read."""
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
    except MemoryError as error:  # its header states a wrong size
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
    total = float(sum(trajectory.rewards.tolist()))
    if not math.isclose(total, result.episode_return, rel_tol=_TOLERANCE, abs_tol=1e-12):
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


def _check_versions(results: Results) -> Finding:
    """Compare the software of the last run with that here."""
    there, here = results.runs[-1].versions, versions()
    stated = {name: (there.get(name), here[name]) for name in _SOFTWARE} | {"commit": (_commit(there), _commit(here))}
    odd = [f"{name} {was} there, {now} here" for name, (was, now) in stated.items() if was != now]
    if odd:
        return Finding("versions", "other here", "; ".join(odd))
    return Finding("versions", "equal", ", ".join(f"{name} {now}" for name, (_, now) in stated.items()))


def _commit(found: Mapping[str, Any]) -> str:
    code = found.get("code")
    state = code.get("vlagents_ray") if isinstance(code, dict) else None
    if not isinstance(state, dict) or state.get("commit") is None:
        return "unknown"
    return f"{state['commit']} with changes" if state.get("diff_sha256") else str(state["commit"])


_CODE = re.compile("trust.*|module|source_dir")  # options that choose code, although they may be words
_WORD = re.compile(r"\w[\w.+-]{0,63}")  # a value that is text, and no path, URL or "module:Class"


@dataclass(frozen=True, slots=True)
class Replayed:
    """The outcome of the recorded actions."""

    steps: int
    outcome: tuple[bool, bool, int | None]  # success once, success at the end, steps after which it was first solved
    differs_from: int | None  # first step with another state, reward or success; 0 is the reset
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
        ConfigError: The environment refuses these options, or is unknown here; also `MissingDependency`.
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
    """Compares an environment with a recording, step by step."""

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


def _check_replays(results: Results, most: int, *, trust: bool) -> Iterator[Finding]:
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
    """Return the first episode with a recording of each cell in turns, then the second of each, and so on."""
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
            elif len(found) < most and (trajectory := _recorded(results, one)) is not None:
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
        f"{name} {str(here.get(name))[:_LENGTH]}, there {str(there.get(name))[:_LENGTH]}"
        for name in sorted(there.keys() | here.keys())
        if there.get(name) != here.get(name)
    ]
    return "; ".join(odd)
