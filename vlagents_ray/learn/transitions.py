"""The recorder of a worker's transitions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.evaluate.artifacts.recorder import Artifacts, EpisodeRecorder
from vlagents_ray.evaluate.episode.records import EpisodeResult, version_of
from vlagents_ray.evaluate.episode.second_pass import SecondPass
from vlagents_ray.evaluate.plan.config import EpisodeChoice, EvalConfig
from vlagents_ray.interface import BEHAVIOUR, WANT, Act, Obs
from vlagents_ray.learn.columns import EXTRA, FINAL, REPLAY, at_rows, constant, tensors, words
from vlagents_ray.registry import require

WANTED = ("logprob", "value", "entropy", REPLAY)  # columns that a policy fills

_FIRST_ROWS = 128  # allocated; unwritten memory costs nothing


class TransitionRecorder(EpisodeRecorder):
    """Keeps the transitions of one episode, as `vlagents_ray.learn.columns` describes them."""

    def __init__(
        self, _config: EvalConfig, _hz: float | None, *, want: Sequence[str] = (), images: bool = True
    ) -> None:
        """Begin an episode."""
        self._pa: Any = require("pyarrow", extra=EXTRA)
        self._want, self._images = tuple(want), images
        self.request_info: Mapping[str, Any] = {WANT: list(want)} if want else {}
        self._seen: dict[str, _Rows] = {}  # the columns of the observations
        self._rows: list[tuple[np.ndarray, float, bool, int, int, str]] = []  # action, reward, success, act, version …
        self._wanted: dict[str, list[float]] = {name: [] for name in self._want if name != REPLAY}
        self._acts = 0
        self._version, self._source = 0, "policy"
        self._next: dict[str, list[float]] = {}  # requested values, for the next rows of the act
        self._replay: dict[str, _Rows] = {}  # a row for each act with executed rows
        self._next_replay: dict[str, np.ndarray] = {}  # until the first row of the act is executed

    @property
    def wants_images(self) -> EpisodeChoice:
        return "all" if self._images else "none"

    def add_observation(self, obs: Obs) -> None:
        seen: dict[str, Any] = {f"cameras.{name}": image for name, image in sorted(obs.cameras.items()) if self._images}
        seen |= {f"state.{name}": part for name, part in sorted(obs.state.items())}
        if obs.gripper is not None:
            seen["gripper"] = np.float32(obs.gripper)
        got = {name: part.shape for name, part in seen.items()}
        if not self._seen:
            self._seen = {name: _Rows(part, np.uint8 if part.ndim == 3 else np.float32) for name, part in seen.items()}
        elif got != (want := {name: rows.shape for name, rows in self._seen.items()}):
            raise EnvFailed(f"env step: got {got}, want {want} as after reset")
        for name, part in seen.items():
            self._seen[name].add(part)

    def add_act(self, act: Act, ticks_waited: int = 0) -> None:
        self._acts += 1
        self._version = version_of(act) or 0
        self._source = str(act.info.get("source", "policy"))
        stated = act.info.get(BEHAVIOUR, {})
        if lacking := [name for name in self._want if name not in stated]:
            raise ConfigError(
                f"want: got no {' and no '.join(lacking)} in act.info[{BEHAVIOUR!r}], which has {sorted(stated)}; "
                f"take a policy that returns it, or leave it out of `want`"
            )
        rows = len(act.rows())
        self._next = {name: _by_row(stated[name], rows, name) for name in self._wanted}
        if REPLAY in self._want:
            self._next_replay = self._checked_replay(stated[REPLAY])

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        row = (np.array(action, np.float32), reward, success, self._acts - 1, self._version, self._source)
        self._rows.append(row)
        for name, values in self._wanted.items():
            values.append(self._next[name].pop(0))
        for name, value in self._next_replay.items():
            self._replay[name].add(value)
        self._next_replay = {}

    def _checked_replay(self, stated: Any) -> dict[str, np.ndarray]:
        """Return an act's replay by name; its shapes must be those of the first act."""
        values = dict(sorted(stated.items())) if isinstance(stated, Mapping) else {}
        values = {name: np.asarray(value) for name, value in values.items()}
        if not values or any(value.dtype.kind not in "iuf" for value in values.values()):
            raise ConfigError(
                f"act.info[{BEHAVIOUR!r}][{REPLAY!r}]: got {stated!r}, want numbers and arrays of numbers by name"
            )
        if not self._replay:
            self._replay = {name: _Rows(value, value.dtype) for name, value in values.items()}
        got = {name: f"{value.dtype} {value.shape}" for name, value in values.items()}
        if got != (want := {name: f"{rows.dtype} {rows.shape}" for name, rows in self._replay.items()}):
            raise ConfigError(f"act.info[{BEHAVIOUR!r}][{REPLAY!r}]: got {got}, want {want} as in the first act")
        return values

    def finish(self, result: EpisodeResult, second_pass: SecondPass) -> Artifacts:
        """Return the transitions of a whole episode; none of one that an error of the policy ended."""
        if result.status != "done":
            return Artifacts()
        return Artifacts(transitions=self._batch(result))

    def _batch(self, result: EpisodeResult) -> Any:
        pa, rows = self._pa, len(self._rows)
        actions, rewards, success, acts, versions, sources = zip(*self._rows, strict=True)
        last = np.arange(rows) == rows - 1
        seen = {name: column.all() for name, column in self._seen.items()}  # (T + 1, ...)
        numbers: dict[str, np.ndarray] = {
            "episode": np.full(rows, result.key.episode, np.int64),
            "t": np.arange(rows, dtype=np.int32),
            "act": np.array(acts, np.int32),
            **{name: values[:-1] for name, values in seen.items()},
            "action": np.stack(actions),
            "reward": np.array(rewards, np.float32),
            "terminated": last & (result.ending == "terminated"),
            "truncated": last & (result.ending != "terminated"),
            "success": np.array(success, np.bool_),
            **{name: np.array(values, np.float32) for name, values in self._wanted.items()},
            "version": np.array(versions, np.int64),
        }
        columns = {"key": constant(pa, str(result.key), rows), "instruction": constant(pa, result.instruction, rows)}
        columns |= {name: tensors(pa, values) for name, values in numbers.items()}
        columns |= {FINAL + name: at_rows(pa, values[-1:], last) for name, values in seen.items()}
        begun = np.diff(acts, prepend=-1) != 0  # first rows of each act
        columns |= {f"{REPLAY}.{name}": at_rows(pa, values.all(), begun) for name, values in self._replay.items()}
        columns["source"] = words(pa, list(sources))
        return pa.RecordBatch.from_pydict(columns)


class _Rows:
    """Arrays of one shape, each copied once into a growing array."""

    def __init__(self, first: np.ndarray, dtype: Any) -> None:
        self.shape, self.dtype = first.shape, dtype
        self._rows = np.empty((_FIRST_ROWS, *first.shape), dtype)
        self._number = 0

    def add(self, row: np.ndarray) -> None:
        if self._number == len(self._rows):
            full, self._rows = self._rows, np.empty((2 * self._number, *self.shape), self.dtype)
            self._rows[: self._number] = full
        self._rows[self._number] = row
        self._number += 1

    def all(self) -> np.ndarray:
        return self._rows[: self._number]


def _by_row(stated: Any, rows: int, name: str) -> list[float]:
    """Return a number for each row of an act: its own sum, or the act's total in the first and NaN in the others.

    `stated` is a number; or (H,) or (H, D) numbers, H rows; or numbers of any other shape, such as one for each token,
    which are summed.
    """
    values = np.asarray(stated, np.float64)
    if values.ndim and len(values) == rows:
        return [float(value) for value in values.reshape(rows, -1).sum(axis=1)]
    if name != "logprob" and values.size != 1:
        raise ConfigError(f"act.info[{BEHAVIOUR!r}][{name!r}]: got shape {values.shape}, want a number, or ({rows},)")
    return [float(values.sum()), *[float("nan")] * (rows - 1)]
