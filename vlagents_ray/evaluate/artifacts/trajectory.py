"""Trajectories: the numbers of an episode step by step in a .npz file, its images in MP4s beside it."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.evaluate.artifacts.storage import (
    TRAJECTORIES,
    episode_folder,
    link_or_copy,
    remove_old,
    require_there,
    stem,
    whole,
)
from vlagents_ray.evaluate.artifacts.video import Footage
from vlagents_ray.evaluate.episode.records import EpisodeObserver, EpisodeResult, version_of
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.interface import Act, Obs
from vlagents_ray.naming import distinct

NO_VERSION = -1  # of a policy that names none, and of steps before its first answer in real-time mode
_STATE = "state/"


@dataclass(frozen=True, slots=True)
class Trajectory:
    """T actions of D numbers each, and T + 1 observations: action i was chosen after observation i.

    The images are in MP4 files beside the .npz file; frame i is that of observation i.
    """

    actions: np.ndarray  # (T, D) float32, as executed
    rewards: np.ndarray  # (T,) float64
    success: np.ndarray  # (T,) bool: whether the task was solved in the state after the action
    state: dict[str, np.ndarray]  # (T + 1, D) float32, in the contract's units
    gripper: np.ndarray | None  # (T + 1,) float32 in [0, 1], 1 = open
    cameras: tuple[str, ...]
    versions: np.ndarray  # (T,) int64, of the weights that chose each action, or NO_VERSION

    def to_bytes(self) -> bytes:
        """Encode the trajectory as an .npz file, in which nothing is pickled."""
        arrays: dict[str, Any] = {"cameras": np.array(self.cameras, str)}
        arrays |= {"actions": self.actions, "rewards": self.rewards, "success": self.success}
        arrays |= {_STATE + part: values for part, values in self.state.items()}
        arrays |= {"versions": self.versions} | ({} if self.gripper is None else {"gripper": self.gripper})
        file = io.BytesIO()
        np.savez_compressed(file, **arrays)
        return file.getvalue()

    @classmethod
    def load(cls, path: Path) -> Trajectory:
        """Read an .npz file that `to_bytes` made.

        Raises:
            ConfigError: The file is missing, or is no trajectory.
        """
        require_there(path)
        try:
            # Opened here: np.load leaves the file of a broken archive open.
            with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
                state = {name.removeprefix(_STATE): file[name] for name in file.files if name.startswith(_STATE)}
                gripper = file["gripper"] if "gripper" in file.files else None
                cameras = tuple(map(str, file["cameras"]))
                return cls(
                    file["actions"], file["rewards"], file["success"], state, gripper, cameras, file["versions"]
                )  # fmt: skip
        except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise ConfigError(f"{path}: cannot be read as a trajectory ({error})") from error


class TrajectoryRecorder(EpisodeObserver):
    """Collects the numbers of one episode."""

    def __init__(self) -> None:
        self._seen: list[dict[str, np.ndarray]] = []
        self._grippers: list[float | None] = []
        self._actions: list[np.ndarray] = []
        self._rewards: list[float] = []
        self._success: list[bool] = []
        self._cameras: tuple[str, ...] = ()
        self._version = NO_VERSION
        self._versions: list[int] = []
        self._next: tuple[int, int] = (0, NO_VERSION)  # steps until the next version, and that version

    def add_observation(self, obs: Obs) -> None:
        """Add an observation. Raises `EnvFailed` if its parts differ from those of the first."""
        state = {part: np.array(values, np.float32) for part, values in obs.state.items()}
        if self._seen and _shapes(state) != _shapes(self._seen[0]):
            raise EnvFailed(f"env step: got the state {_shapes(state)}, want {_shapes(self._seen[0])} as after reset")
        if self._grippers and (obs.gripper is None) != (self._grippers[0] is None):
            raise EnvFailed("env step: an observation has a gripper, another of the same episode has none")
        self._cameras = self._cameras or tuple(sorted(obs.cameras))  # those of the reset; a later one may lack them
        self._seen.append(state)
        self._grippers.append(obs.gripper)

    def add_act(self, act: Act, ticks_waited: int = 0) -> None:
        version = version_of(act)
        self._next = ticks_waited, NO_VERSION if version is None else version

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        after, version = self._next
        if after == 0:
            self._version = version
        self._next = after - 1, version
        self._versions.append(self._version)
        self._actions.append(np.array(action, np.float32))
        self._rewards.append(reward)
        self._success.append(success)

    def finish(self) -> Trajectory:
        """Return the trajectory; if no action was executed, the shape of `actions` is (0, 0)."""
        return Trajectory(
            np.stack(self._actions) if self._actions else np.zeros((0, 0), np.float32),
            np.array(self._rewards, np.float64),
            np.array(self._success, np.bool_),
            {part: np.stack([state[part] for state in self._seen]) for part in self._seen[0]},
            None if self._grippers[0] is None else np.array(self._grippers, np.float32),
            self._cameras,
            np.array(self._versions, np.int64),
        )


def save_trajectory(
    out: Path, cell: EvalCase, result: EpisodeResult, trajectory: bytes | None, footage: Footage, videos: Sequence[str]
) -> str | None:
    """Write `out/trajectories/POLICY/SUITE/ENV/epNNNN_seedS.npz` and `_CAMERA.mp4`; returns the first's path in `out`.

    `videos` are the paths of `footage.shown`, in its order, so that no file is written twice. The .npz is written last:
    if it exists, the other files do. Files of an earlier attempt at the episode are removed.
    """
    saved = dict(zip(footage.shown, videos, strict=True))
    folder = episode_folder(out, TRAJECTORIES, cell)
    remove_old(folder, result.key)
    if trajectory is None:
        return None
    path = folder / f"{stem(result.key)}.npz"
    seen = videos_of(path, footage.seen)
    for camera, video in footage.seen.items():
        if camera in footage.shown:
            link_or_copy(out / saved[camera], seen[camera])
        else:
            with whole(seen[camera]) as part:
                part.write_bytes(video)
    with whole(path) as part:
        part.write_bytes(trajectory)
    return str(path.relative_to(out))


def videos_of(trajectory: Path, cameras: Iterable[str]) -> dict[str, Path]:
    """Return the MP4s of the policy's images by camera; `cameras` are the trajectory's. Frame i is observation i."""
    return {camera: trajectory.with_name(f"{trajectory.stem}_{name}.mp4") for camera, name in distinct(cameras).items()}


def _shapes(state: Mapping[str, np.ndarray]) -> dict[str, tuple[int, ...]]:
    return {part: values.shape for part, values in sorted(state.items())}
