"""A policy that replays recorded actions, to reproduce a rollout or to test the connection of a robot."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs

_KEYS = ("actions", "action")  # names of the array, in this order, if a file has several


class ReplayConfig(BaseModel, extra="forbid"):
    """Settings of `Replay`: the recording, and the behaviour after its last row."""

    path: Path = Field(description="a .npy, .npz or .json file of (T, D) actions")
    key: str | None = Field(default=None, description="the array's name in a .npz or .json file that holds several")
    at_end: Literal["hold", "zeros", "error"] = Field(
        default="hold", description="after the last row: repeat it, send zeros, or fail"
    )
    chunk: int = Field(default=1, ge=1, description="rows an `act` returns; 1 gives a single action, (D,)")


class Replay(Agent):
    """Returns the rows of a recording in order, from its start in each episode."""

    Config: ClassVar[type] = ReplayConfig
    shared: ClassVar[tuple[str, ...]] = ("config", "actions")

    def __init__(self, config: ReplayConfig) -> None:
        self.config = config
        self.actions: np.ndarray | None = None  # (T, D) float32
        self._next = 0

    @property
    def contract(self) -> Contract:
        dim = None if self.actions is None else self.actions.shape[1]
        return Contract(action=ActionSpec(dim=dim), chunk=self.config.chunk)

    def initialize(self) -> None:
        """Read the recording; raises `ConfigError` if it is missing, or not (T, D) finite numbers."""
        self.actions = load_actions(self.config.path, self.config.key)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._next = 0
        return {} if self.actions is None else {"rows": len(self.actions)}

    def act(self, obs: Obs) -> Act:
        if self.actions is None:
            raise PolicyFailed("replay: act before initialize; the recording is not loaded")
        rows = self.actions[self._next : self._next + self.config.chunk]
        absent = self.config.chunk - len(rows)
        if absent:
            rows = np.concatenate([rows, self._after_end(absent)])
        self._next += self.config.chunk
        return Act(rows[0].copy() if self.config.chunk == 1 else rows.copy())

    def _after_end(self, count: int) -> np.ndarray:
        if self.actions is None or self.config.at_end == "error":
            have = 0 if self.actions is None else len(self.actions)
            raise PolicyFailed(
                f"replay: {self.config.path.name} ended after {have} rows; "
                f"record a longer one, or set at_end to 'hold' or 'zeros'"
            )
        last = self.actions[-1]
        return np.tile(last if self.config.at_end == "hold" else np.zeros_like(last), (count, 1))


def load_actions(path: Path, key: str | None = None) -> np.ndarray:
    """Return recorded actions, (T, D) float32, of a .npy, .npz or .json file; raises `ConfigError` if it has none."""
    if not path.is_file():
        raise ConfigError(f"recording {path}: no such file")
    readers = {".npy": _read_npy, ".npz": _read_npz, ".json": _read_json}
    if path.suffix not in readers:
        raise ConfigError(f"recording {path}: got {path.suffix!r}, want one of {sorted(readers)}")
    try:
        actions = np.asarray(readers[path.suffix](path, key), dtype=np.float32)
    except (OSError, EOFError, TypeError, ValueError, zipfile.BadZipFile) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"recording {path}: cannot be read as numbers ({error})") from error
    if actions.ndim != 2 or actions.size == 0:
        raise ConfigError(f"recording {path}: got shape {actions.shape}, want (T, D) with T and D at least 1")
    if not np.isfinite(actions).all():
        raise ConfigError(f"recording {path}: has NaN or infinity, want finite numbers")
    return actions


def _read_npy(path: Path, key: str | None) -> Any:
    if key is not None:
        raise ConfigError(f"recording {path}: key {key!r} is for .npz and .json; a .npy file holds one array")
    with path.open("rb") as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _read_npz(path: Path, key: str | None) -> Any:
    with path.open("rb") as file:  # opened here: np.load leaves the file of a broken archive open
        arrays = np.load(file, allow_pickle=False)
        if not hasattr(arrays, "files"):
            raise ConfigError(f"recording {path}: holds one bare array; rename it to .npy")
        return arrays[_choose(path, list(arrays.files), key)]


def _read_json(path: Path, key: str | None) -> Any:
    data = json.loads(path.read_text(encoding="utf-8"))
    return data[_choose(path, list(data), key)] if isinstance(data, dict) else data


def _choose(path: Path, have: list[str], key: str | None) -> str:
    wanted = (key,) if key is not None else _KEYS
    for name in wanted:
        if name in have:
            return name
    if key is None and len(have) == 1:
        return have[0]
    raise ConfigError(f"recording {path}: got {sorted(have)}, want {' or '.join(map(repr, wanted))}; set `key`")
