"""The log of an evaluation on a robot: one line a trial, with the policy's name encrypted.

`trials.jsonl` is written while the evaluation runs, in place of results.db. Its verdicts are plain text; the policy,
its checkpoint and its timing are encrypted with the key that draws the order of trials, in parts of one length. This
prevents the operator from seeing them by accident; the key opens them.
"""

from __future__ import annotations

import base64
import fcntl
import hashlib
import hmac
import json
import os
import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.storage import storing
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EvalConfig, canonical
from vlagents_ray.evaluate.results.database import FILE as RESULTS

LOG, KEY = "trials.jsonl", "trials.key"
_NONCE = 16  # bytes
_BLOCK = 16384  # bytes: sealed parts have a multiple of this length, which hides the policy
_KILLED = "the evaluation ended before the verdict"


@dataclass(frozen=True, slots=True)
class LoggedTrial:
    """An attempt at a trial in the log."""

    trial: int
    attempt: int
    at: float  # s since 1970, of its end
    seen: dict[str, Any]  # in plain text: outcome, earned, score, note; or `again`, the reason of a repetition
    sealed: dict[str, Any]  # the parts that reveal the policy

    @property
    def finished(self) -> bool:
        """Whether the trial has a result, so that it is not played again."""
        return "again" not in self.seen


class TrialLog:
    """The log in one folder, open for one evaluation at a time. Use as a context manager."""

    def __init__(self, config: EvalConfig, cells: Sequence[EvalCase]) -> None:
        """Open or begin the log in `config.out`.

        Raises:
            ConfigError: There is a log and `config.resume` is off, or it has another plan or key; there are results of
                a simulation; or another evaluation writes to the folder.
            StorageFailed: The folder cannot be written to.
        """
        self._path = config.out / LOG
        self.attempts: list[LoggedTrial] = []
        with storing(config.out):
            config.out.mkdir(parents=True, exist_ok=True)
            resumed = self._path.exists() and self._path.stat().st_size > 0
            if not resumed and (config.out / RESULTS).exists():
                raise ConfigError(f"{config.out}: has results of another evaluation; choose another out folder")
            if resumed and not config.resume:
                raise ConfigError(f"{config.out}: already has trials; resume them (--resume), or choose another folder")
            self.key = _key(config)
            self._file = self._path.open("a+b")
        try:
            self._lock()
            plan = canonical([[cell.fingerprint, *cell.name, cell.planned, cell.suite.seeds] for cell in cells])
            self._read(config, hmac.digest(self.key, plan.encode(), hashlib.sha256).hex())
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> TrialLog:
        return self

    def __exit__(self, *exc: object) -> None:
        self._file.close()

    @property
    def finished(self) -> dict[int, LoggedTrial]:
        """The trials that have a result, by their number."""
        return {one.trial: one for one in self.attempts if one.finished}

    def next_attempt(self, trial: int) -> int:
        """Return the number of the next attempt at a trial, from 1."""
        return 1 + sum(one.trial == trial for one in self.attempts)

    def why_again(self, trial: int) -> str:
        """Return the reason why a trial is repeated; "" if it has not been played."""
        return next((one.seen["again"] for one in reversed(self.attempts) if one.trial == trial), "")

    def begin(self, trial: int, attempt: int) -> None:
        """Record that an attempt begins. If no end follows, the evaluation was killed."""
        self._write({"trial": trial, "attempt": attempt, "begun": time.time()})

    def end(self, trial: int, attempt: int, seen: dict[str, Any], sealed: dict[str, Any]) -> LoggedTrial:
        ended = LoggedTrial(trial, attempt, time.time(), seen, sealed)
        line = {"trial": trial, "attempt": attempt, "at": ended.at, **seen, "sealed": _seal(self.key, sealed)}
        self._write(line)
        self.attempts.append(ended)
        return ended

    def note_unblinded(self) -> None:
        """Record that the results were written before all trials were played."""
        self._write({"unblinded": time.time()})

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigError(
                f"{self._path}: another evaluation is writing there; wait for it, or choose another folder"
            ) from error

    def _read(self, config: EvalConfig, identity: str) -> None:
        self._file.seek(0)
        data = self._file.read()
        whole = data.rfind(b"\n") + 1  # the process was killed while it wrote an incomplete line
        self._file.truncate(whole)
        lines = [json.loads(line) for line in data[:whole].splitlines()]
        if not lines:
            self.started = time.time()
            plan = {"config": json.loads(config.model_dump_json(exclude_unset=True))}
            self._write({"plan": identity, "at": self.started, "sealed": _seal(self.key, plan)})
            return
        if not hmac.compare_digest(lines[0]["plan"], identity):
            raise ConfigError(f"{self._path}: is of another plan, robot or key; take those, or another out folder")
        self.started = float(lines[0]["at"])
        begun: set[tuple[int, int]] = set()
        for line in lines[1:]:
            if "unblinded" in line:
                continue
            place = line.pop("trial"), line.pop("attempt")
            if "begun" in line:
                begun.add(place)
                continue
            begun.discard(place)
            self.attempts.append(
                LoggedTrial(*place, line.pop("at"), sealed=_unseal(self.key, line.pop("sealed")), seen=line)
            )
        for place in begun:
            self.end(*place, {"again": _KILLED, "cause": "operator"}, {})

    def _write(self, line: dict[str, Any]) -> None:
        with storing(self._path.parent):
            self._file.write(canonical(line).encode() + b"\n")
            self._file.flush()
            os.fsync(self._file.fileno())


def logged_plan(out: Path, key: str | None) -> EvalConfig:
    """Return the plan of the log in a folder, with the policies' URLs."""
    try:
        with (out / LOG).open("rb") as file:
            first = json.loads(file.readline())
        secret = key.encode() if key is not None else (out / KEY).read_bytes().strip()
        return EvalConfig.model_validate(_unseal(secret, first["sealed"])["config"])
    except FileNotFoundError as error:
        raise ConfigError(f"{error.filename}: is missing; want the folder of an evaluation on a robot") from error
    except ValueError as error:
        raise ConfigError(f"{out / LOG}: cannot be read with this key; want the `robot.key` of its plan") from error


def _seal(key: bytes, content: dict[str, Any]) -> str:
    text = json.dumps(content, default=str).encode()
    text += b" " * (-len(text) % _BLOCK)
    nonce = secrets.token_bytes(_NONCE)
    return base64.b64encode(nonce + _crypt(key, nonce, text)).decode()


def _unseal(key: bytes, text: str) -> dict[str, Any]:
    data = base64.b64decode(text)
    return dict(json.loads(_crypt(key, data[:_NONCE], data[_NONCE:])))


def _crypt(key: bytes, nonce: bytes, text: bytes) -> bytes:
    """Encrypt or decrypt with SHAKE-256 of key and nonce as the key stream."""
    stream = hashlib.shake_256(b"vlagents_ray trials" + key + nonce).digest(len(text))
    return bytes(a ^ b for a, b in zip(text, stream, strict=True))


def _key(config: EvalConfig) -> bytes:
    """Return the plan's key, or the one drawn for this folder."""
    given = config.real_robot.key if config.real_robot is not None else None
    if given is not None:
        return given.encode()
    path = config.out / KEY
    if not path.exists() or not path.stat().st_size:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(secrets.token_hex(32))
    return path.read_text().strip().encode()
