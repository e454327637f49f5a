"""Checks of a bundle: its digests, its database, its recordings, and a replay of some episodes.

A replay executes recorded actions in their environment, and compares the results; it needs no
policy.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import random
import re
import secrets
import sqlite3
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.evaluate.artifacts import storage
from vlagents_ray.evaluate.artifacts.recorder import NO_VERSION, Trajectory
from vlagents_ray.evaluate.episode.records import Ending, EpisodeResult, Status
from vlagents_ray.evaluate.plan.config import fingerprint
from vlagents_ray.evaluate.report.page import FILE as REPORT
from vlagents_ray.evaluate.report.page import write_report
from vlagents_ray.evaluate.results.database import FILE as DATABASE
from vlagents_ray.evaluate.results.reader import CaseResults, Episode, Results, reading, table
from vlagents_ray.evaluate.results.summary import summarize, write_summary
from vlagents_ray.registry import env_suite, names
from vlagents_ray_results.bundle import MANIFEST, MOST_BYTES, require_file, unpack
from vlagents_ray_results.recorded_actions import replay_actions

Verdict = Literal["equal", "differs", "other here", "not checked"]
MOST_TRAJECTORY = 2**30  # maximum size of a trajectory, unpacked, bytes
# Relative tolerance: sums of floating-point numbers may differ in their last bits.
_TOLERANCE = 1e-9
_SHOWN = 3  # maximum number of differences in a finding
_LENGTH = 80  # maximum number of characters of a value in a finding


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check.

    "differs" means that the bundle contradicts itself, or that a replay had another outcome. "other
    here" means other software or numbers on this machine, which alone do not contradict the bundle.
    """

    subject: str
    verdict: Verdict
    detail: str


@dataclass(frozen=True, slots=True)
class Verification:
    """The findings on a bundle."""

    digest: str  # SHA-256 of the bundle's manifest, which identifies its content
    findings: list[Finding]
    seed: int  # seed with which the replayed episodes were drawn

    @property
    def holds(self) -> bool:
        """Whether nothing contradicts the bundle."""
        return all(finding.verdict != "differs" for finding in self.findings)


def verify(
    bundle: Path,
    *,
    into: Path | None = None,
    replay: int = 3,
    seed: int | None = None,
    trust: bool = False,
    most_bytes: int = MOST_BYTES,
) -> Verification:
    """Check a bundle, which may come from a stranger.

    Nothing in it is run, imported or unpickled. Its environments are only created if they are
    registered here and their options are numbers and words, unless `trust` is set.

    Args:
        bundle: The file of the bundle.
        into: A new folder for the bundle's results, which can be read, merged and exported like any
            others; None removes the results. The folder's summary and report are written from the
            database.
        replay: The number of episodes whose recorded actions are executed again.
        seed: The seed with which these episodes are drawn; None selects a new seed, which the
            author of the bundle cannot know.
        trust: Whether the bundle's environments may name any code and files.
        most_bytes: The maximum size of all files of the bundle, bytes.

    Returns:
        The findings.

    Raises:
        ConfigError: The file is not a bundle or is larger than allowed, its database cannot be
            read, or `into` exists.
        StorageFailed: The disk is full, or cannot be written to.
    """
    if into is not None and into.exists():
        raise ConfigError(f"{into}: expected a new folder, got one that exists; choose another")
    require_file(bundle)
    if seed is None:
        seed = secrets.randbits(32)

    parent = None if into is None else into.absolute().parent
    with storage.storing(parent or Path(tempfile.gettempdir())):
        if parent is not None:
            parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="bundle.part-", dir=parent) as temporary:
            # The report contains the folder's name.
            folder = Path(temporary) / (into or bundle).name
            folder.mkdir()

            manifest, digest, differences = unpack(bundle, folder, most_bytes=most_bytes)
            fine = f"{len(manifest.files)} files have the SHA-256 listed in {MANIFEST}"
            findings = [_finding("digests", differences, fine)]

            try:
                findings += _check(folder, replay, seed, trust=trust)
            except (VLAgentsError, sqlite3.Error):
                raise
            except (
                ArithmeticError,
                LookupError,
                RecursionError,
                TypeError,
                ValueError,
                AttributeError,
            ) as error:
                raise ConfigError(
                    f"{bundle}: its database holds values that no evaluation writes "
                    f"({type(error).__name__}: {error}); do not trust its author"
                ) from error

            if into is not None:
                os.replace(folder, into)
    return Verification(digest, findings, seed)


def _check(folder: Path, replay: int, seed: int, *, trust: bool) -> Iterator[Finding]:
    """Yield all findings except that about the digests; also write summary and report."""
    if not (folder / DATABASE).is_file():
        raise ConfigError(
            f"expected a bundle that `vlagents-ray bundle` wrote, got one without {DATABASE}"
        )
    results = Results.load(folder)
    if not results.runs or not results.cases:
        raise ConfigError(f"{DATABASE}: expected the results of an evaluation, got none")

    yield _check_cases(results)
    yield _check_episodes(results)
    write_summary(summarize(results))
    write_report(results, folder / REPORT)
    yield _check_trajectories(results)
    yield _check_versions(results)
    if not replay:
        yield Finding("replay", "not checked", "was not requested (--replay 0)")
        return

    chosen = list(islice(_drawn_recordings(results, seed), replay))
    if not chosen:
        yield Finding(
            "replay", "not checked", "no finished episode has a recording (eval --record all)"
        )
    for case, episode, trajectory in chosen:
        yield _replay(case, episode, trajectory, trust=trust)


def _drawn_recordings(
    results: Results, seed: int
) -> Iterator[tuple[CaseResults, Episode, Trajectory]]:
    """Yield the drawn episodes that have a recording."""
    for case, episode in _drawn(results, seed):
        trajectory = _recorded(results, episode)
        if trajectory is not None:
            yield case, episode, trajectory


def _drawn(results: Results, seed: int) -> Iterator[tuple[CaseResults, Episode]]:
    """Yield the finished episodes in a random order, one of each case in turn, so that each case is
    checked.
    """
    draw = random.Random(seed)
    cases = []
    for case in results.cases:
        done = [episode for episode in case.episodes if episode.result.status == "done"]
        cases.append([(case, episode) for episode in done])

    draw.shuffle(cases)
    for episodes in cases:
        draw.shuffle(episodes)
    for turn in zip_longest(*cases):
        yield from (pair for pair in turn if pair is not None)


def _check_cases(results: Results) -> Finding:
    """Check that the keys of cases and episodes match their settings, and that nothing was mixed or
    left out.
    """
    contradictions = []
    known_keys: set[str] = set()
    rules = {json.dumps(run.config.get("stop"), sort_keys=True) for run in results.runs}
    for case in results.cases:
        name = f"{case.policy_id} in {case.task}"
        env_and_policy = case.settings.get("env"), case.settings.get("policy")
        has_fingerprint = fingerprint(case.settings) == case.case_id
        if not has_fingerprint or env_and_policy != (case.env, case.policy):
            contradictions.append(f"{name}: its settings are not those of its key")
        rule = None if case.stop is None else case.stop.model_dump(mode="json")
        if json.dumps(rule, sort_keys=True) not in rules:
            contradictions.append(f"{name}: no run stopped early by its rule")
        for episode in case.episodes:
            key = episode.result.key
            known_keys.add(str(key))
            if key.env != case.env:
                contradictions.append(f"{key}: is of another case or env")
        contradictions += [f"{name}: {text}" for text in _mixtures(results, case)]

    with reading(results.out) as db:
        keys = {row["key"] for row in table(db, "episodes")}
    for unknown_key in sorted(keys - known_keys):
        contradictions.append(
            f"{unknown_key}: its key does not match its columns, or it has no case"
        )

    return _finding(
        "database",
        contradictions,
        f"keys match the settings of all cases ({len(results.cases)}) and episodes ({len(keys)})",
    )


# All episodes of a case have the same value in each of these columns. A run whose change was
# accepted may have added another value, but no other checkpoint.
_ONE_OF_A_CASE = ("checkpoint", "weights", "env_program", "policy_program")


def _mixtures(results: Results, case: CaseResults) -> Iterator[str]:
    """Yield differences between the episodes of a case that no evaluation would have written."""
    for column in _ONE_OF_A_CASE:
        if results.accepted_changes and column != "checkpoint":
            continue
        if column.endswith("_program"):
            values = {getattr(episode, column) for episode in case.episodes if episode.counts}
        else:  # the value is unknown for an episode that failed in the policy's reset
            values = {getattr(episode.result, column) for episode in case.episodes} - {None}
        if len(values) > 1:
            yield (
                f"its episodes have {len(values)} values of {column}, and no accepted change "
                "says so"
            )

    fingerprints_by_version: dict[int, set[str]] = {}
    for episode in case.episodes:
        result = episode.result
        if result.policy_version is not None and result.policy_fingerprint is not None:
            fingerprints = fingerprints_by_version.setdefault(result.policy_version, set())
            fingerprints.add(result.policy_fingerprint)
    for version, fingerprints in fingerprints_by_version.items():
        if len(fingerprints) > 1:
            yield f"version {version} of the weights has {len(fingerprints)} fingerprints"

    has_unplanned = any(episode.unplanned for episode in case.episodes)
    plan_changed = any(change.subject == "plan" for change in results.accepted_changes)
    if has_unplanned and not plan_changed:
        yield (
            "it has episodes beyond its plan, in no rate, and no accepted change says that the "
            "plan became smaller"
        )


def _check_episodes(results: Results) -> Finding:
    """Check that the columns of each episode do not contradict each other."""
    contradictions: list[str] = []
    runs = {run.run for run in results.runs}
    recordings: dict[str, int] = {}  # the number of episodes by path of the recording
    number = 0
    for case in results.cases:
        for episode in case.episodes:
            number += 1
            texts = list(_inconsistencies(case, episode))
            if episode.run not in runs:
                texts.append(f"there is no run {episode.run}")
            contradictions += [f"{episode.result.key}: {text}" for text in texts]
            if episode.trajectory is not None:
                recordings[episode.trajectory] = recordings.get(episode.trajectory, 0) + 1

    for recording, times in recordings.items():
        if times > 1:
            contradictions.append(f"{recording}: is the recording of {times} episodes")

    files = (results.out / storage.TRAJECTORIES).rglob("*.npz")
    for name in sorted(str(file.relative_to(results.out)) for file in files):
        if name not in recordings:
            contradictions.append(f"{name}: is the recording of no episode")

    return _finding("episodes", contradictions, f"the columns of {number} episodes are consistent")


def _inconsistencies(case: CaseResults, episode: Episode) -> Iterator[str]:
    """Yield the contradictions between the columns of one episode."""
    result = episode.result
    outcome = (result.success_once, result.success_at_end, result.first_success)
    if result.status not in get_args(Status) or result.ending not in get_args(Ending):
        yield (
            f"got the status {result.status!r} and the ending {result.ending!r}, which no "
            "evaluation writes"
        )
    is_done = result.status == "done"
    if is_done != (result.error is None) or is_done != (result.ending != "error"):
        yield f"its error or ending ({result.ending}) contradicts its status {result.status!r}"
    if result.status == "infra_failed":
        if outcome != (None, None, None) or result.steps or result.actions_sha256 is not None:
            yield "it failed by infrastructure, but has an outcome"
        if episode.trajectory is not None:
            yield "it failed by infrastructure, but has a recording"
        return

    if result.status == "policy_error" and outcome != (False, False, None):
        yield "an error of the policy ended it, but it was solved"

    solved_after = result.first_success
    if None in outcome[:2] or result.success_once != (solved_after is not None):
        yield "success_once contradicts first_success"
    elif solved_after is not None and not 1 <= solved_after <= result.steps:
        yield f"it was solved after {solved_after} of {result.steps} steps"
    elif (result.success_at_end and not result.success_once) or (
        solved_after is not None and solved_after == result.steps and not result.success_at_end
    ):
        yield "success_at_end contradicts first_success"

    pushed = case.settings.get("pushed_weights")
    acted = (result.first_policy_version, result.policy_version, result.policy_fingerprint)
    if pushed and result.policy_version is not None:
        expected = (pushed["version"], pushed["version"], pushed["fingerprint"])
        if acted != expected:
            yield (
                f"versions {acted[0]} to {acted[1]} ({acted[2]}) acted, not {expected[0]} "
                f"({expected[2]})"
            )

    yield from _inconsistent_ticks(case, result)


def _inconsistent_ticks(case: CaseResults, result: EpisodeResult) -> Iterator[str]:
    """Yield the contradictions between the columns about ticks, and with the clock of the case."""
    has_clock = case.settings.get("clock") is not None
    if not has_clock and (result.ticks_waited, result.latency_ms) != (0, None):
        yield "it waited for answers, but its environment did not advance in the meantime"

    ages_ms = [result.age_p50_ms, result.age_p95_ms, result.age_p99_ms]
    known_ages_ms = [age_ms for age_ms in ages_ms if age_ms is not None]
    time_share = result.time_share
    if not has_clock and case.settings.get("robot") is None:
        if (result.ticks, result.starved, known_ages_ms) != (None, None, []):
            yield "it has ticks in time, but its environment waited for the policy"
        return
    if time_share is None:
        yield "its ticks are missing"
        return

    ticks, starved = time_share.ticks, time_share.starved
    if has_clock and (ticks != result.steps or not starved <= result.ticks_waited <= ticks):
        yield (
            f"{starved} starved of {ticks} ticks, {result.ticks_waited} waited, of "
            f"{result.steps} steps"
        )
    if not 0 <= starved <= ticks:
        yield f"{starved} starved of {ticks} ticks"
    has_ages = [True] * 3 if known_ages_ms else [False] * 3
    if [age_ms is not None for age_ms in ages_ms] != has_ages:
        yield f"it has some of the ages {ages_ms}, but not all"
    if known_ages_ms != sorted(known_ages_ms) or min(known_ages_ms, default=0.0) < 0:
        yield f"expected ages in ascending order, none below 0 ms, got {known_ages_ms}"
    if has_clock and bool(known_ages_ms) != (starved < ticks):
        yield f"{ticks - starved} ticks in time, but the ages {ages_ms}"


def _check_trajectories(results: Results) -> Finding:
    """Check that each recording has the actions, steps, rewards and success of its episode in
    the table.
    """
    contradictions: list[str] = []
    checked, missing = 0, 0
    for case in results.cases:
        for episode in case.episodes:
            if episode.result.status == "infra_failed":
                continue
            trajectory = _recorded(results, episode)
            if trajectory is None:
                missing += 1
                continue

            checked += 1
            synchronous = case.settings.get("clock") is None
            texts = _contradictions(episode, trajectory, synchronous=synchronous)
            contradictions += [f"{episode.result.key}: {text}" for text in texts]

    if not checked and not contradictions:
        return Finding(
            "trajectories",
            "not checked",
            f"the bundle has none of {missing} episodes (eval --record all)",
        )
    fine = f"{checked} match the actions, rewards and outcomes in the database"
    if missing:
        fine += f"; {missing} others have no recording, so their outcomes cannot be checked"
    return _finding("trajectories", contradictions, fine)


def _recorded(results: Results, episode: Episode) -> Trajectory | None:
    """Return the recording of an episode; None if the bundle has none. Raises `ConfigError` if
    it cannot be read.
    """
    if episode.trajectory is None:
        return None
    path = results.file(episode.trajectory)
    if not path.is_file():
        return None

    try:
        with zipfile.ZipFile(path) as file:
            size = sum(member.file_size for member in file.infolist())
    except (OSError, zipfile.BadZipFile) as error:
        raise ConfigError(
            f"{episode.trajectory}: cannot be read as a trajectory ({error})"
        ) from error
    if size > MOST_TRAJECTORY:
        raise ConfigError(
            f"{episode.trajectory}: expected at most {MOST_TRAJECTORY} unpacked bytes, got {size}"
        )

    try:
        return Trajectory.load(path)
    except MemoryError as error:  # the file's header declares a wrong size
        raise ConfigError(
            f"{episode.trajectory}: declares a size that does not fit into memory"
        ) from error


def _contradictions(
    episode: Episode, trajectory: Trajectory, *, synchronous: bool
) -> Iterator[str]:
    """Yield the contradictions between a recording and its episode in the table."""
    result = episode.result
    steps = len(trajectory.actions)
    if not _has_one_length(trajectory) or result.steps != steps:
        yield f"{result.steps} steps in the table, another number in the recording"
        return

    actions = np.ascontiguousarray(trajectory.actions, "<f4").tobytes()
    if hashlib.sha256(actions).hexdigest() != result.actions_sha256:
        yield "the recorded actions do not match the digest in the table"
    total = float(sum(trajectory.rewards.tolist()))
    if not math.isclose(total, result.episode_return, rel_tol=_TOLERANCE, abs_tol=1e-12):
        yield "the recorded rewards have another sum"

    # An episode that ended with an error of the policy counts as unsuccessful, whatever was
    # recorded.
    if result.status != "done":
        return
    outcome = (result.success_once, result.success_at_end, result.first_success)
    if _outcome(trajectory.success.astype(bool).tolist()) != outcome:
        yield "the recorded success differs from the table"
    versions = [int(version) for version in trajectory.versions if version != NO_VERSION]
    acted = (versions[0], versions[-1]) if versions else (None, None)
    # In real-time mode, an answer may remain unused.
    if synchronous and acted != (result.first_policy_version, result.policy_version):
        yield "the recorded versions of the weights differ from the table"


def _has_one_length(trajectory: Trajectory) -> bool:
    """Return whether each step has an action, a reward, a success and a version, and each
    observation has its numbers.
    """
    steps = len(trajectory.actions)
    of_steps = [
        values.shape for values in (trajectory.rewards, trajectory.success, trajectory.versions)
    ]
    of_observations = [len(values) for values in trajectory.state.values()]
    if trajectory.gripper is not None:
        of_observations.append(trajectory.gripper.size)
    return set(of_steps) == {(steps,)} and set(of_observations) <= {steps + 1}


def _outcome(success: list[bool]) -> tuple[bool, bool, int | None]:
    """Return whether the task was solved once, whether it was solved at the end, and the number of
    steps after which it was first solved.
    """
    first = next((number for number, solved in enumerate(success, 1) if solved), None)
    return first is not None, bool(success and success[-1]), first


def _finding(subject: str, contradictions: list[str], fine: str) -> Finding:
    """Return the finding of a check: the first contradictions, or `fine` if there are none."""
    if not contradictions:
        return Finding(subject, "equal", fine)
    more = f"; and {len(contradictions) - _SHOWN} more" if len(contradictions) > _SHOWN else ""
    return Finding(subject, "differs", "; ".join(contradictions[:_SHOWN]) + more)


def _check_versions(results: Results) -> Finding:
    """Compare the software of the last run with the software of this machine."""
    run_versions = results.runs[-1].versions
    local_versions = storage.versions()
    pairs = {}
    for name, version in local_versions.items():
        if name != "code":
            pairs[name] = (run_versions.get(name), version)
    pairs["commit"] = (_commit(run_versions), _commit(local_versions))

    differences = []
    for name, (run_version, local_version) in pairs.items():
        if run_version != local_version:
            differences.append(f"{name} {run_version} there, {local_version} here")
    if differences:
        return Finding("versions", "other here", "; ".join(differences))

    texts = [f"{name} {version}" for name, (_, version) in pairs.items()]
    return Finding("versions", "equal", ", ".join(texts))


def _commit(versions: Mapping[str, Any]) -> str:
    code = versions.get("code")
    state = code.get("vlagents_ray") if isinstance(code, dict) else None
    if not isinstance(state, dict) or state.get("commit") is None:
        return "unknown"
    return f"{state['commit']} with changes" if state.get("diff_sha256") else str(state["commit"])


# Options that choose code, even if their values are words.
_CODE = re.compile("trust.*|module|source_dir")
_WORD = re.compile(r"\w[\w.+-]{0,63}")  # a text value that is not a path, URL or "module:Class"


def require_harmless(case: CaseResults) -> None:
    """Raise `ConfigError` if creating this environment could run other code than that of a
    registered environment.

    A bundle may come from a stranger: "module:Class" would be imported, and an option that is a
    path or a nested value could name files or code of this machine. `trust_remote_code` from a
    bundle is rejected: only the local user can grant it.
    """
    if env_suite(case.env) not in names("envs") or ":" in case.env:
        raise ConfigError(
            f"{case.env}: is not a registered environment; --trust creates it, and runs its code"
        )
    for kind in ("env_options", "reset_options"):
        risky = {}
        for name, value in (case.settings.get(kind) or {}).items():
            if _CODE.fullmatch(name) or not _is_plain(value):
                risky[name] = value
        if risky:
            raise ConfigError(
                f"{case.env}: expected {kind} that cannot name files or code, got {risky}; give "
                "--trust if you trust their author"
            )


def _is_plain(value: object) -> bool:
    if isinstance(value, list):
        return all(_is_plain(item) for item in value)
    if isinstance(value, str):
        return _WORD.fullmatch(value) is not None
    return value is None or isinstance(value, bool | int | float)


def _replay(case: CaseResults, episode: Episode, trajectory: Trajectory, *, trust: bool) -> Finding:
    subject = f"replay of {case.env}#{episode.result.key.episode}@{episode.result.key.seed}"
    if case.settings.get("robot") is not None:
        return Finding(subject, "not checked", "it was played on a real robot")
    if not _has_one_length(trajectory):
        return Finding(
            subject,
            "differs",
            "its recording has different numbers of actions and observations",
        )

    try:
        if not trust:
            require_harmless(case)
        played = replay_actions(case, episode, trajectory)
    except VLAgentsError as error:
        return Finding(subject, "not checked", str(error))

    result = episode.result
    outcome = _outcome(played.success)
    steps = len(played.success)
    first = min(played.differences, default=None)
    largest = max(played.differences.values(), default=0.0)
    differs = f"the numbers differ since step {first} of {steps}, by at most {largest:.3g}"
    if first is None:
        differs = "all numbers are bit-identical"

    texts = {
        "ending": (played.ending, result.ending),
        "instruction": (played.instruction, result.instruction),
    }
    for name, (replayed, recorded) in texts.items():
        if replayed != recorded:
            return Finding(
                subject,
                "differs",
                f"its {name} is {replayed[:_LENGTH]!r} here, {recorded[:_LENGTH]!r} there",
            )

    if outcome != (result.success_once, result.success_at_end, result.first_success):
        solved_here = "solved" if outcome[0] else "not solved"
        solved_there = "solved" if result.success_once else "not solved"
        return Finding(subject, "differs", f"{solved_here} here, {solved_there} there; {differs}")

    detail = f"{steps} actions: all states, rewards and successes are bit-identical"
    if first is not None:
        detail = f"the same outcome, other numbers; {differs}"

    differing = []
    for name in sorted(case.described.keys() | played.described.keys()):
        description = case.described.get(name)
        description_here = played.described.get(name)
        if description != description_here:
            differing.append(
                f"{name} {str(description_here)[:_LENGTH]}, there {str(description)[:_LENGTH]}"
            )
    if differing:
        detail += f"; the environment describes itself here as: {'; '.join(differing)}"
    return Finding(subject, "equal" if first is None else "other here", detail)
