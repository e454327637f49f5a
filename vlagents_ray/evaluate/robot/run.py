"""Runs the trials of an evaluation on a robot, and writes the results when all trials have a
verdict.

Until then, two files replace results.db. The log, `trials.jsonl`, has a line for each attempt at a
trial, with the verdict. The policy, its checkpoint and its timing are in `trials.hidden.jsonl`,
which the operator must not open. The lines of the log are a chain: each contains the HMAC of its
fields, of the hash of its hidden line, and of the line before it. So no line can be changed, added
or deleted later without the key; only the ends of both files can be cut off together.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import hashlib
import hmac
import json
import logging
import os
import secrets
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError, ContractMismatch, VLAgentsError, from_code
from vlagents_ray.evaluate.artifacts.storage import driver_code, save_diffs, storing, versions
from vlagents_ray.evaluate.episode.failures import Failure, explain
from vlagents_ray.evaluate.episode.records import EnvInfo, EpisodeResult
from vlagents_ray.evaluate.plan.config import EvalConfig, canonical
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan, resolve
from vlagents_ray.evaluate.results.changes import changed
from vlagents_ray.evaluate.results.database import FILE as RESULTS
from vlagents_ray.evaluate.results.early_stopping import EarlyStopping
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.results.summary import Summary
from vlagents_ray.evaluate.robot.operator import (
    Operator,
    Verdict,
    VisibleTrial,
    save_start,
    start_pictures,
)
from vlagents_ray.evaluate.robot.trial import (
    PlayedTrial,
    Trial,
    WatchedRobot,
    play,
    rehearse,
    schedule,
)
from vlagents_ray.evaluate.run import conclude
from vlagents_ray.evaluate.workers.rollout import AgentFactory, agents
from vlagents_ray.registry import require
from vlagents_ray.robot.loop import Robot, opened, robot_factory

LOG = "trials.jsonl"
HIDDEN = "trials.hidden.jsonl"
KEY = "trials.key"
# The lengths of hidden lines are padded to multiples of this number of bytes, so that the size of
# the file does not reveal the policy.
_BLOCK = 16384
_RESTORE = "restore both files from one copy, or choose another out folder"
_LINE = "line"  # field of a hidden line: its line in the log
_KILLED = "the evaluation ended before the verdict"


@dataclass(frozen=True, slots=True)
class LoggedTrial:
    """One attempt at a trial in the log."""

    trial: int
    attempt: int
    at: float  # time at which the attempt ended, s since 1970
    # Fields that the operator may read: outcome, earned, score and note; or `again`, the reason of
    # a repetition.
    visible: dict[str, Any]
    hidden: dict[str, Any]  # fields that reveal the policy

    @property
    def finished(self) -> bool:
        """Whether the trial has a result and is not repeated."""
        return "again" not in self.visible


class TrialLog(contextlib.AbstractContextManager["TrialLog"]):
    """The log of trials in one folder, open for one evaluation at a time."""

    def __init__(self, plan: ResolvedPlan) -> None:
        """Open the log in `plan.out`, or create a new log.

        Raises:
            ConfigError: The folder has a log and `plan.resume` is False, the log belongs to another
                plan or key, a line of it was changed or deleted, the folder has results of a
                simulation, or another evaluation is writing to the folder.
            StorageFailed: The folder cannot be written to.
        """
        self._path = plan.out / LOG
        self._last_mac = ""  # the HMAC of the last line
        self.attempts: list[LoggedTrial] = []
        with storing(plan.out):
            plan.out.mkdir(parents=True, exist_ok=True)
            resumed = self._path.exists() and self._path.stat().st_size > 0
            if not resumed and (plan.out / RESULTS).exists():
                raise ConfigError(
                    f"{plan.out}: has results of another evaluation; choose another out folder"
                )
            if resumed and not plan.resume:
                raise ConfigError(
                    f"{plan.out}: already has trials; resume them (--resume), or choose another "
                    "folder"
                )
            self.key = _key(plan)

        with contextlib.ExitStack() as files:
            with storing(plan.out):
                self._log = files.enter_context(_JsonLines(self._path))
                self._hidden = files.enter_context(_JsonLines(plan.out / HIDDEN, mode=0o600))
            self._log.lock()

            cases = []
            for case in plan.cases:
                cases.append([case.fingerprint, *case.name, case.planned, case.suite.seeds])
            self._read(plan, _hash(self.key, canonical(cases).encode()))
            self._files = files.pop_all()

    def __exit__(self, *exc: object) -> None:
        self._files.close()

    @property
    def finished(self) -> dict[int, LoggedTrial]:
        """The trials with a result, by the number of the trial."""
        return {logged.trial: logged for logged in self.attempts if logged.finished}

    def of(self, trial: int) -> list[LoggedTrial]:
        """Return the attempts at the trial with this number, in order."""
        return [logged for logged in self.attempts if logged.trial == trial]

    def begin(self, trial: int, attempt: int) -> None:
        """Record that an attempt begins. If no end is recorded, the evaluation was killed."""
        self._write({"trial": trial, "attempt": attempt, "begun": time.time()})

    def end(
        self, trial: int, attempt: int, visible: dict[str, Any], hidden: dict[str, Any]
    ) -> None:
        """Record the end of an attempt, with the fields `visible` and `hidden` of `LoggedTrial`."""
        at = time.time()
        self._write({"trial": trial, "attempt": attempt, "at": at, **visible}, hidden)
        self.attempts.append(LoggedTrial(trial, attempt, at, visible, hidden))

    def note_unblinded(self) -> None:
        """Record that the results were written before all trials had run."""
        self._write({"unblinded": time.time()})

    def _read(self, plan: ResolvedPlan, identity: str) -> None:
        """Read the attempts from the log, or create the log; `identity` is the hash of the plan's
        cases.
        """
        lines = [self._parsed(line) for line in self._log.read()]
        hidden_lines = self._hidden.read()
        if not lines:
            if len(hidden_lines) > 1:
                raise ConfigError(
                    f"{self._path}: expected a line for each line of {HIDDEN}, got none; {_RESTORE}"
                )
            # The process may have been killed before it wrote the first line.
            self._hidden.clear()
            self.started = time.time()
            settings = json.loads(plan.settings.model_dump_json(exclude_unset=True))
            self._write({"plan": identity, "at": self.started}, {"config": settings})
            return

        if lines[0].get("plan") != identity:
            raise ConfigError(
                f"{self._path}: expected a log of this plan, robot and key, got the log of another "
                f"plan, robot or key; use the same ones, or choose another out folder"
            )
        hidden_of_lines = self._verified(lines, hidden_lines)
        self.started = float(lines[0]["at"])
        unfinished_attempts: set[tuple[int, int]] = set()
        for line, hidden in zip(lines[1:], hidden_of_lines[1:], strict=True):
            if "unblinded" in line:
                continue

            attempt = line.pop("trial"), line.pop("attempt")
            if "begun" in line:
                unfinished_attempts.add(attempt)
                continue

            unfinished_attempts.discard(attempt)
            visible = {name: value for name, value in line.items() if name != "hidden"}
            fields = json.loads(hidden or b"{}")
            fields.pop(_LINE, None)
            self.attempts.append(LoggedTrial(*attempt, visible.pop("at"), visible, fields))

        for attempt in unfinished_attempts:
            self.end(*attempt, {"again": _KILLED, "cause": "operator"}, {})

    def _parsed(self, text: bytes) -> dict[str, Any]:
        """Return the fields of a line; raises `ConfigError` if the line is not a JSON object."""
        with contextlib.suppress(ValueError):
            line = json.loads(text)
            if isinstance(line, dict):
                return line
        raise ConfigError(f"{self._path}: expected lines in JSON, got {text[:60]!r}; {_RESTORE}")

    def _verified(
        self, lines: list[dict[str, Any]], hidden_lines: Sequence[bytes]
    ) -> list[bytes | None]:
        """Return the hidden line of each line, or None; and remove the HMAC from each line.

        Raises:
            ConfigError: A line is not the one that was written after the line before it, or its
                hidden line is missing, or a hidden line has no line.
        """
        hidden_left = deque((_hash(self.key, hidden), hidden) for hidden in hidden_lines)
        hidden_of_lines: list[bytes | None] = []
        for number, line in enumerate(lines, 1):
            mac = line.pop("mac", None)
            expected = self._mac(line)
            if mac != expected:
                raise ConfigError(
                    f"{self._path}: expected lines as they were written, got a line {number} that "
                    f"was changed, or lines deleted before it; {_RESTORE}"
                )
            self._last_mac = expected
            if "hidden" not in line:
                hidden_of_lines.append(None)
                continue
            if not hidden_left or hidden_left[0][0] != line["hidden"]:
                owner = f"trial {line['trial']}" if "trial" in line else "the plan"
                raise ConfigError(
                    f"{self._path}: the hidden line of {owner} is missing in {HIDDEN}, or was "
                    f"changed; {_RESTORE}"
                )
            hidden_of_lines.append(hidden_left.popleft()[1])

        self._complete(lines, hidden_of_lines, [hidden for _, hidden in hidden_left])
        return hidden_of_lines

    def _complete(
        self,
        lines: list[dict[str, Any]],
        hidden_of_lines: list[bytes | None],
        hidden_left: Sequence[bytes],
    ) -> None:
        """Write the last line from its hidden line, if the process was killed between the two.

        Raises:
            ConfigError: Hidden lines have no line, although the process was not killed.
        """
        if not hidden_left:
            return
        begun, line = lines[-1], {}
        with contextlib.suppress(ValueError):
            line = json.loads(hidden_left[0])[_LINE]
        # An attempt has one end, so a single hidden line can be the end of the last attempt.
        is_end = all(begun.get(name) == line.get(name, "") for name in ("trial", "attempt"))
        if len(hidden_left) > 1 or "begun" not in begun or not is_end:
            raise ConfigError(
                f"{self._path}: expected a line for each line of {HIDDEN}, got {len(hidden_left)} "
                f"results without one; {_RESTORE}"
            )
        line["hidden"] = _hash(self.key, hidden_left[0])
        self._append(line)
        lines.append(line)
        hidden_of_lines.append(hidden_left[0])

    def _write(self, line: dict[str, Any], hidden: dict[str, Any] | None = None) -> None:
        if hidden is None:
            self._append(line)
            return
        text = json.dumps({**hidden, _LINE: line}, default=str).encode()
        text += b" " * (-len(text) % _BLOCK)
        with storing(self._path.parent):
            # Write the hidden line before the line with its hash, since the process may be killed
            # in between. The hidden line contains the line.
            self._hidden.append(text)
        self._append({**line, "hidden": _hash(self.key, text)})

    def _append(self, line: dict[str, Any]) -> None:
        """Append a line with its HMAC."""
        mac = self._mac(line)
        with storing(self._path.parent):
            self._log.append(canonical({**line, "mac": mac}).encode())
        self._last_mac = mac

    def _mac(self, line: dict[str, Any]) -> str:
        """Return the HMAC of a line after the last one."""
        return _hash(self.key, f"{self._last_mac}\n{canonical(line)}".encode())


class _JsonLines(contextlib.AbstractContextManager["_JsonLines"]):
    """A file to which lines are appended."""

    def __init__(self, path: Path, mode: int = 0o666) -> None:
        self._path = path
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, mode)
        self._file = os.fdopen(descriptor, "a+b")

    def lock(self) -> None:
        """Lock the file; raise `ConfigError` if another process has locked it."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigError(
                f"{self._path}: another evaluation is writing there; wait for it, or choose "
                "another folder"
            ) from error

    def read(self) -> list[bytes]:
        """Return all complete lines, and delete an incomplete line, which a killed process may have
        left.
        """
        self._file.seek(0)
        data = self._file.read()
        complete = data.rfind(b"\n") + 1
        self._file.truncate(complete)
        return data[:complete].splitlines()

    def clear(self) -> None:
        """Delete all lines."""
        self._file.truncate(0)

    def append(self, line: bytes) -> None:
        """Append a line, and flush it to the disk."""
        self._file.write(line + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def __exit__(self, *exc: object) -> None:
        self._file.close()


def logged_plan(out: Path, key: str | None) -> EvalConfig:
    """Return the plan of the log in a folder, with the policies' URLs.

    Args:
        out: The folder of an evaluation on a robot.
        key: The plan's key; None reads it from the folder.

    Raises:
        ConfigError: The folder has no log, or its log belongs to another key.
    """
    try:
        with (out / LOG).open("rb") as file:
            first = json.loads(file.readline())
        secret = key.encode() if key is not None else (out / KEY).read_bytes().strip()
        hidden_lines = _by_hash(secret, (out / HIDDEN).read_bytes().splitlines())
        plan = json.loads(hidden_lines[first["hidden"]])
        return EvalConfig.model_validate(plan["config"])
    except FileNotFoundError as error:
        raise ConfigError(
            f"expected the folder of an evaluation on a robot, got a folder without "
            f"{error.filename}; check the path"
        ) from error
    except (KeyError, ValueError) as error:
        raise ConfigError(
            f"{out / LOG}: expected a log of this key, got the log of another key; use the "
            f"`robot.key` of its plan"
        ) from error


def _hash(key: bytes, line: bytes) -> str:
    return hmac.digest(key, line, hashlib.sha256).hex()


def _by_hash(key: bytes, lines: Iterable[bytes]) -> dict[str, bytes]:
    """Return hidden lines by their hashes, which the log contains."""
    return {_hash(key, line): line for line in lines}


def _key(plan: ResolvedPlan) -> bytes:
    """Return the plan's key or, if there is none, the random key of this folder, which is created
    if necessary.
    """
    robot, _ = plan.cases[0].on_robot
    if robot.key is not None:
        return robot.key.encode()

    path = plan.out / KEY
    if not path.exists() or not path.stat().st_size:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(secrets.token_hex(32))
    return path.read_text().strip().encode()


RECORDINGS = "recordings"
# Loggers whose messages may contain the name of a policy.
_LOGGERS = ("vlagents_ray", "ray", "ray.serve", "websockets", "asyncio")


class TrialsInterrupted(KeyboardInterrupt):
    """The operator or a signal ended an evaluation on a robot. `resume` continues with the next
    trial.

    No results are written yet, since they would unblind the remaining trials.
    """


def evaluate_on_robot(
    config: EvalConfig,
    operator: Operator,
    *,
    robot: Robot | None = None,
    agent_factory: AgentFactory | None = None,
) -> Summary:
    """Run every trial of `config` that has no result yet, and write the results to `config.out`.

    The order of the policies is random (`schedule`). Until the last verdict, only the hidden file
    in the folder (see `TrialLog`) contains the policies of the trials; no output and no log
    contains them. results.db, summary.json and report.html are written at the end, as for a
    simulation. With `config.stop`, a task ends only when all its cases have stopped, since trials
    of only the remaining cases would reveal their policies.

    Args:
        config: The policies, with their URLs, and the plan, with `robot`.
        operator: The operator at the robot.
        robot: The robot; by default an object of the class `config.robot.arm`.
        agent_factory: Called with a case to create the agent for a trial; by default, the agent
            is a connection to the policy's `url`.

    Returns:
        The summary of all results in `config.out`.

    Raises:
        ConfigError: The settings are invalid or contradict the log in `config.out`, or a policy
            changed between trials.
        MissingDependency: The settings request recordings, and the extra "record" is not installed.
        StorageFailed: The disk is full, or cannot be written to.
        TrialsInterrupted: The operator ended the evaluation, or Ctrl-C did.
        VLAgentsError: A policy cannot be reached, or fails, before the first trial.
    """
    require_trials(config)
    return play_trials(resolve(config), operator, robot=robot, agent_factory=agent_factory)


def play_trials(
    plan: ResolvedPlan,
    operator: Operator,
    *,
    robot: Robot | None = None,
    agent_factory: AgentFactory | None = None,
) -> Summary:
    """Evaluate like `evaluate_on_robot`, with a plan that is already resolved.

    Args:
        plan: The plan, whose configuration passes `require_trials`.
        operator: The operator at the robot.
        robot: The robot; by default an object of the class `config.robot.arm`.
        agent_factory: Called with a case to create the agent for a trial; by default, the agent
            is a connection to the policy's `url`.

    Returns:
        The summary of all results in the plan's folder.

    Raises:
        VLAgentsError: As in `evaluate_on_robot`.
        TrialsInterrupted: The operator ended the evaluation, or Ctrl-C did.
    """
    if plan.record != "none":
        for module in ("av", "pyarrow"):
            require(module)

    factory = agent_factory or agents(plan, None, "robot")
    with contextlib.ExitStack() as stack:
        if robot is None:
            settings, _ = plan.cases[0].on_robot
            robot = stack.enter_context(opened(robot_factory("--robot", str(settings.arm))))
        log = stack.enter_context(TrialLog(plan))
        trials = schedule(plan.cases, log.key)
        run = _RemainingTrials(plan, operator, WatchedRobot(robot), factory, log, trials)
        try:
            with _quiet():
                run.play()
        except KeyboardInterrupt:
            raise TrialsInterrupted(
                f"interrupted after {len(log.finished)} of {len(trials)} trials; continue with "
                f"--resume --out {plan.out}"
            ) from None
    return _write_results(plan, log, "complete")


def unblind(out: Path, key: str | None = None) -> Summary:
    """Write the results of the trials judged so far; all later trials are no longer blind.

    Args:
        out: The folder of an evaluation on a robot.
        key: The plan's key; None reads it from the folder.

    Returns:
        The summary of these results.

    Raises:
        ConfigError: The folder has no trials, or its log belongs to another key.
    """
    config = logged_plan(out, key).model_copy(update={"out": out, "resume": True})
    require_trials(config)
    plan = resolve(config)
    with TrialLog(plan) as log:
        log.note_unblinded()
    return _write_results(plan, log, "interrupted")


def require_trials(config: EvalConfig) -> None:
    """Raise `ConfigError` if a plan has no robot, or has settings that do not apply to a robot."""
    if config.real_robot is None:
        raise ConfigError(
            "robot: expected `robot: {tasks: …}` in the plan and the robot's class (--robot), "
            "got no robot; give both"
        )
    swept = [policy.name for policy in config.policies if policy.steps]
    if swept:
        raise ConfigError(
            f"steps: expected none with a robot, whose trials alternate between the policies, got "
            f"some of {swept}; name each checkpoint as a policy, with `config: {{checkpoint_step: "
            "N}}`"
        )
    if any(policy.pushed_weights is not None for policy in config.policies):
        raise ConfigError(
            "pushed_weights: expected none with a robot, got some; leave out this setting"
        )
    if config.track:
        raise ConfigError(
            f"track: expected none with a robot, got {config.track}; leave it out, as rates would "
            "unblind the policies before the end"
        )
    if config.record_images != "small":
        raise ConfigError(
            "record_images: expected 'small' with a robot, whose trials are recorded in lossy "
            f"H.264, got {config.record_images!r}; leave it out"
        )


@dataclasses.dataclass(slots=True)
class _RemainingTrials:
    """Runs the remaining trials one after another."""

    _plan: ResolvedPlan
    _operator: Operator
    _robot: WatchedRobot
    _factory: AgentFactory
    _log: TrialLog
    _trials: Sequence[Trial]
    _message: str = ""  # note about the last trial, for the operator
    _stopping: EarlyStopping = dataclasses.field(init=False)
    # The fingerprints of the cases of each task.
    _cases_of_task: dict[tuple[str, str], set[str]] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        self._stopping = EarlyStopping(self._plan)
        for trial in self._trials:
            case_id = trial.job.case.fingerprint
            self._cases_of_task.setdefault(trial.task, set()).add(case_id)
        for number, logged in self._log.finished.items():
            self._stopping.add(result_of(self._trials[number - 1], logged))

    def play(self) -> None:
        """Rehearse the policies, then run each trial until it has a result."""
        remaining = [trial for trial in self._trials if self._is_due(trial)]
        if not remaining:
            return

        obs = self._robot.observe()
        case_of_policy = {trial.job.case.policy_id: trial.job.case for trial in remaining}
        # Sort by name, since this order reveals nothing about the order of the trials.
        for policy_id in sorted(case_of_policy):
            case = case_of_policy[policy_id]
            try:
                rehearse(case, self._robot, self._factory, self._operator, obs)
            except ContractMismatch as error:
                raise ContractMismatch(
                    f"a policy of this plan does not fit the robot. This message does not name the "
                    f"policy, as the trials are blind; `vlagents-ray robot URL --robot "
                    f"{case.on_robot[0].arm}` "
                    "compares one policy with the robot, before any motion.\n"
                    f"{error}"
                ) from None
            except VLAgentsError as error:
                raise from_code(error.code, f"policy {case.policy_id!r}: {error}") from error

        for trial in remaining:
            while self._is_due(trial):
                self._play(trial)

    def _is_due(self, trial: Trial) -> bool:
        """Return whether a trial has no result and its task is not over."""
        return trial.number not in self._log.finished and not self._is_over(trial)

    def _play(self, trial: Trial) -> None:
        """Run one attempt at a trial, and record the verdict or the reason of a repetition."""
        view = self._visible(trial)
        attempt = view.attempt
        if not self._operator.prepare(view, self._robot.observe):
            raise KeyboardInterrupt

        finished_scenes = {self._trials[number - 1].scene_name for number in self._log.finished}
        if trial.scene_name not in finished_scenes:
            with storing(self._plan.out):
                save_start(self._plan.out, trial.scene_name, self._robot.observe())

        self._log.begin(trial.number, attempt)
        try:
            recording = None
            if self._plan.record != "none":
                name = f"trial{trial.number:04d}-{attempt}"
                recording = self._plan.out / RECORDINGS / name
            played = play(trial, self._robot, self._factory, self._operator, recording)
        except VLAgentsError as error:
            failure = explain(error)
            reason, cause = f"it could not be run ({failure.code})", "policy"
            if failure.code == "env_failed":
                reason, cause = failure.message, "worker"
            repetition = {"again": reason, "cause": cause}
            self._log.end(trial.number, attempt, repetition, dataclasses.asdict(failure))
            return

        self._require_same_policy(trial, played)
        if played.result.status == "policy_error":
            verdict = Verdict("failure", note=played.ending)
            self._record(trial, attempt, played, verdict, played.result)
            self._message = f"trial {trial.number}: {played.ending}, so it counts as a failure"
            return

        self._message = ""
        verdict = self._operator.judge(view, played.ending)
        score = verdict.score(view.rubric)
        if verdict.outcome == "repeat":
            self._log.end(trial.number, attempt, {"again": verdict.note, "cause": "operator"}, {})
            return

        # A partial success counts as a failure in the success rates; the score is stored as the
        # return.
        success = verdict.outcome == "success"
        result = dataclasses.replace(
            played.result,
            first_success=played.result.steps if success else None,
            success_once=success,
            success_at_end=success,
            episode_return=score,
        )
        self._record(trial, attempt, played, verdict, result)

    def _record(
        self,
        trial: Trial,
        attempt: int,
        played: PlayedTrial,
        verdict: Verdict,
        result: EpisodeResult,
    ) -> None:
        visible = {
            "outcome": verdict.outcome,
            "earned": sorted(set(verdict.earned)),
            "note": verdict.note,
            "score": result.episode_return,
            "ending": played.ending,
        }
        hidden = {"result": dataclasses.asdict(result), "metadata": played.metadata}
        self._log.end(trial.number, attempt, visible, hidden)
        self._stopping.add(result)

    def _is_over(self, trial: Trial) -> bool:
        """Return whether all cases of the trial's task have stopped early."""
        return all(map(self._stopping.has_stopped, self._cases_of_task[trial.task]))

    def _visible(self, trial: Trial) -> VisibleTrial:
        robot, task = trial.job.case.on_robot
        earlier_attempts = self._log.of(trial.number)
        message = self._message
        if earlier_attempts:
            message = f"repeated: {earlier_attempts[-1].visible['again']}"

        return VisibleTrial(
            number=trial.number,
            total=len(self._trials),
            task=" ".join(filter(None, trial.task)),
            scene=trial.scene,
            attempt=len(earlier_attempts) + 1,
            instruction=task.instruction,
            setup=task.setup,
            seconds=task.max_steps / robot.hz,
            rubric=task.rubric,
            start=start_pictures(self._plan.out, trial.scene_name),
            message=message,
        )

    def _require_same_policy(self, trial: Trial, played: PlayedTrial) -> None:
        """Raise `ConfigError` if the policy has changed. The message does not name the policy or
        its trials.
        """
        case = trial.job.case
        for number, logged in self._log.finished.items():
            earlier_case = self._trials[number - 1].job.case
            if earlier_case.policy.name != case.policy.name:
                continue

            difference = changed(
                logged.hidden["metadata"], played.metadata, swept=case.step is not None
            )
            if difference is None and earlier_case.policy_id == case.policy_id:
                difference = _changed_weights(logged.hidden["result"], played.result)
            if difference is not None:
                raise ConfigError(
                    f"the {difference} of a policy has changed since its earlier trials; serve all "
                    "policies as before and continue with --resume, or choose another out folder"
                )


def _changed_weights(earlier: dict[str, Any], result: EpisodeResult) -> str | None:
    """Return "checkpoint" if the checkpoints of two results differ, otherwise "weights" if the
    weights differ, otherwise None.

    Args:
        earlier: The fields of the earlier result.
        result: The present result.
    """
    for name in ("checkpoint", "weights"):
        value = getattr(result, name)
        if value and earlier[name] and value != earlier[name]:
            return name
    return None


def result_of(trial: Trial, logged: LoggedTrial) -> EpisodeResult:
    """Return the result of a finished trial from the log.

    Raises:
        ConfigError: The result in the log belongs to another plan.
    """
    fields = dict(logged.hidden["result"])
    fields["key"] = EpisodeKey(**fields["key"])
    if fields["key"] != trial.job.key:
        raise ConfigError(
            f"trial {trial.number}: expected a result of this plan, got a result of another plan; "
            f"choose another out folder"
        )
    return EpisodeResult(**fields)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Return a context manager that silences the loggers of this package and of Ray, since their
    messages may name the policy.
    """
    loggers = {name: logging.getLogger(name) for name in _LOGGERS}
    levels = {name: logger.level for name, logger in loggers.items()}
    for logger in loggers.values():
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for name, logger in loggers.items():
            logger.setLevel(levels[name])


def _write_results(plan: ResolvedPlan, log: TrialLog, state: str) -> Summary:
    """Write results.db from the whole log, in the form of an evaluation in simulation, and replace
    an earlier file.
    """
    trials = schedule(plan.cases, log.key)
    with storing(plan.out):
        (plan.out / RESULTS).unlink(missing_ok=True)

    with Store(dataclasses.replace(plan, resume=True)) as store, storing(plan.out):
        store.begin_run(versions(), log.started)
        save_diffs(plan.out, driver_code().values())

        case_of_place = {case.place: case for case in plan.cases}
        for case in case_of_place.values():
            settings, _ = case.on_robot
            store.note_env(case.place, EnvInfo({"robot": settings.arm}, {}))

        for logged in log.attempts:
            trial = trials[logged.trial - 1]
            job = dataclasses.replace(trial.job, attempt=logged.attempt)
            if not logged.finished:
                if logged.visible["cause"] == "operator":
                    failure = Failure("operator", "trial_repeated", logged.visible["again"])
                else:
                    failure = Failure(**logged.hidden)
                store.record_attempt(job, failure, retried=True)
                continue

            if logged.hidden["metadata"]:
                store.note_policy(trial.job.case.policy.name, logged.hidden["metadata"])
            store.record(result_of(trial, logged), logged.attempt, finished=logged.at)

        return conclude(store, state)
