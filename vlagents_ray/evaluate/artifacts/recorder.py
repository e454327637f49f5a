"""The artifacts of an episode: videos for people and a trajectory for programs.

A trajectory consists of a .npz file with the numbers of every step, and of MP4 files with the
policy's images. The worker encodes each frame immediately, as H.264, which browsers can decode.
Encoding a frame of 224x224 takes about 0.3 ms, less than a JPEG, so no thread is needed and no
backlog arises. Files are created in memory and sent to the driver with the episode's result. This
works on any node, and a worker that dies leaves no partial files.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError, EnvFailed, InvalidObservation
from vlagents_ray.evaluate.artifacts import storage
from vlagents_ray.evaluate.episode.records import EpisodeObserver, EpisodeResult, version_of
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EpisodeChoice, RecordedImages
from vlagents_ray.images.mp4 import Mp4
from vlagents_ray.interface import Act, Obs
from vlagents_ray.naming import distinct, plain

DEFAULT_FPS = 20.0  # frame rate for an env whose contract has no control rate


class VideoRecorder(EpisodeObserver):
    """Videos of one episode, one for each camera. `close` frees the encoders."""

    def __init__(self, fps: float | None = None, *, lossless: bool = False) -> None:
        """Create a recorder without images.

        Args:
            fps: The frames per second; None: `DEFAULT_FPS`.
            lossless: Whether to encode without loss, in a format that browsers cannot decode.
        """
        self._fps = fps or DEFAULT_FPS
        self._lossless = lossless
        self._tracks: dict[str, tuple[io.BytesIO, Mp4]] = {}  # the encoder of each camera

    def add_observation(self, obs: Obs) -> None:
        """Append every camera's image, (H, W, 3) uint8 RGB."""
        for name, image in obs.cameras.items():
            if name not in self._tracks:
                file = io.BytesIO()
                track = Mp4(file, image.shape, self._fps, lossless=self._lossless)
                self._tracks[name] = file, track
            try:
                self._tracks[name][1].add(image)
            except InvalidObservation as error:
                raise EnvFailed(f"camera {name!r}: {error}") from error

    def finish(self) -> dict[str, bytes]:
        """Finish and return the videos by camera; the recorder is empty afterwards."""
        videos: dict[str, bytes] = {}
        while self._tracks:
            name, (file, track) = self._tracks.popitem()
            track.finish()
            videos[name] = file.getvalue()
        return dict(sorted(videos.items()))

    def close(self) -> None:
        """Discard the unfinished videos."""
        while self._tracks:
            _, (_, track) = self._tracks.popitem()
            track.abandon()


def save_videos(
    out: Path, case: EvalCase, result: EpisodeResult, videos: dict[str, bytes]
) -> list[str]:
    """Write `out/videos/POLICY/SUITE/ENV/epNNNN_seedS_OUTCOME_CAMERA.mp4` for each camera.

    A suite without a name has no folder. Two cameras never share a file
    (`vlagents_ray.naming.distinct`). A file is renamed to its final name when it is complete. Files
    of an earlier attempt at the episode are removed.

    Returns:
        The paths relative to `out`.
    """
    folder = _folder_for(out, storage.VIDEOS, case, result)
    names = distinct(videos)

    written = []
    for camera, data in videos.items():
        path = folder / f"{_stem(result)}_{storage.outcome(result)}_{names[camera]}.mp4"
        with storage.whole(path) as unfinished_path:
            unfinished_path.write_bytes(data)
        written.append(str(path.relative_to(out)))
    return written


def _folder_for(out: Path, category: str, case: EvalCase, result: EpisodeResult) -> Path:
    """Return the folder `out/CATEGORY/POLICY/SUITE/ENV`, after removing the episode's files of an
    earlier attempt.
    """
    subfolders = [plain(name) for name in case.name if name]
    folder = out.joinpath(category, *subfolders)
    for earlier_file in folder.glob(f"{_stem(result)}[_.]*"):
        earlier_file.unlink()
    return folder


def _stem(result: EpisodeResult) -> str:
    """Return the common beginning of the names of an episode's files, before "_" or "."."""
    return f"ep{result.key.episode:04d}_seed{result.key.seed}"


# The version for a policy that reports none, and for steps before the first answer in real-time
# mode.
NO_VERSION = -1
_STATE = "state/"  # prefix of the names of the state's arrays in the .npz file
# The largest trajectory, unpacked, bytes: the file may come from another person, and an episode of
# an hour at 50 Hz with 1,000 numbers in each state has 720 MB.
_MOST_BYTES = 2**30


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A trajectory: T actions of D numbers each, and T + 1 observations; action i was chosen after
    observation i.

    The images are in MP4 files next to the .npz file; frame i belongs to observation i.
    """

    actions: np.ndarray  # (T, D) float32, the executed actions
    rewards: np.ndarray  # (T,) float64
    success: np.ndarray  # (T,) bool: whether the task was solved in the state after the action
    state: dict[str, np.ndarray]  # (T + 1, D) float32, in the contract's units
    gripper: np.ndarray | None  # (T + 1,) float32 in [0, 1], 1 = open
    cameras: tuple[str, ...]
    # (T,) int64: the version of the weights that chose each action, or NO_VERSION
    versions: np.ndarray
    instructions: np.ndarray  # (T,) text: the instruction that the policy had at each step

    def to_bytes(self) -> bytes:
        """Encode the trajectory as an .npz file without pickled objects."""
        arrays: dict[str, Any] = {"cameras": np.array(self.cameras, str)}
        arrays |= {"actions": self.actions, "rewards": self.rewards, "success": self.success}
        arrays |= {_STATE + name: values for name, values in self.state.items()}
        arrays |= {"versions": self.versions, "instructions": self.instructions}
        if self.gripper is not None:
            arrays["gripper"] = self.gripper

        file = io.BytesIO()
        np.savez_compressed(file, **arrays)
        return file.getvalue()

    @classmethod
    def load(cls, path: Path) -> Trajectory:
        """Read an .npz file that `to_bytes` made.

        Raises:
            ConfigError: The file is missing, too large, or does not contain a trajectory.
        """
        storage.require_there(path)
        try:
            with zipfile.ZipFile(path) as archive:
                size = sum(member.file_size for member in archive.infolist())
            if size > _MOST_BYTES:
                raise ValueError(f"expected at most {_MOST_BYTES} unpacked bytes, got {size}")

            # Open the file here, since np.load does not close the file of a broken archive.
            with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
                state = {}
                for name in file.files:
                    if name.startswith(_STATE):
                        state[name.removeprefix(_STATE)] = file[name]

                gripper = file["gripper"] if "gripper" in file.files else None
                cameras = tuple(map(str, file["cameras"]))

                return cls(
                    file["actions"],
                    file["rewards"],
                    file["success"],
                    state,
                    gripper,
                    cameras,
                    file["versions"],
                    file["instructions"],
                )
        except (
            OSError,
            EOFError,
            ValueError,
            KeyError,
            MemoryError,  # the header of an array declares a wrong size
            zipfile.BadZipFile,
            zlib.error,
        ) as error:
            raise ConfigError(f"{path}: cannot be read as a trajectory ({error})") from error

    def __post_init__(self) -> None:
        """Raise `ValueError` unless each array has the type and the length that its comment
        declares.
        """
        steps = len(self.actions) if self.actions.ndim else 0
        form = [
            ("actions", self.actions, "float32", 2, steps),
            ("rewards", self.rewards, "float64", 1, steps),
            ("success", self.success, "bool", 1, steps),
            ("versions", self.versions, "int64", 1, steps),
            ("instructions", self.instructions, "str", 1, steps),
        ]
        for name, values in self.state.items():
            form.append((_STATE + name, values, "float32", max(1, values.ndim), steps + 1))
        if self.gripper is not None:
            form.append(("gripper", self.gripper, "float32", 1, steps + 1))

        for name, values, kind, dimensions, length in form:
            is_of_kind = values.dtype.kind == "U" if kind == "str" else values.dtype == kind
            if not is_of_kind or values.ndim != dimensions or len(values) != length:
                raise ValueError(
                    f"{name}: expected {length} rows of {kind} in {dimensions} dimensions, got the "
                    f"shape {values.shape} of {values.dtype}"
                )


class TrajectoryRecorder(EpisodeObserver):
    """Collects the numbers of one episode."""

    def __init__(self) -> None:
        self._states: list[dict[str, np.ndarray]] = []  # state of each observation
        self._grippers: list[float | None] = []  # gripper of each observation
        # Action, reward, success, version and instruction of each step.
        self._steps: list[tuple[np.ndarray, float, bool, int, str]] = []
        self._cameras: tuple[str, ...] = ()
        self._version = NO_VERSION
        self._instruction = ""
        # The next version, and the number of steps until it applies.
        self._next: tuple[int, int] = (0, NO_VERSION)

    def add_instruction(self, instruction: str) -> None:
        """Add an instruction; it applies to the next actions."""
        self._instruction = instruction

    def add_observation(self, obs: Obs) -> None:
        """Add an observation.

        Raises:
            EnvFailed: The state has other parts or shapes than in the first observation, or only
                one of these two observations has a gripper.
        """
        state = {name: np.array(values, np.float32) for name, values in obs.state.items()}
        if self._states and _shapes(state) != _shapes(self._states[0]):
            raise EnvFailed(
                f"env step: expected the state {_shapes(self._states[0])} as after reset, got "
                f"{_shapes(state)}"
            )

        if self._grippers and (obs.gripper is None) != (self._grippers[0] is None):
            raise EnvFailed(
                "env step: expected a gripper in all observations of an episode or in none, got "
                "both"
            )

        # Keep the cameras of the reset, since a later observation may lack them.
        self._cameras = self._cameras or tuple(sorted(obs.cameras))
        self._states.append(state)
        self._grippers.append(obs.gripper)

    def add_act(self, act: Act, ticks_waited: int = 0) -> None:
        """Record the version of weights in an answer; it applies after `ticks_waited` further
        actions.
        """
        if self._next[0] == 0:  # no action was executed since the last answer applied
            self._version = self._next[1]
        version = version_of(act)
        self._next = ticks_waited, NO_VERSION if version is None else version

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        """Add an executed action, (D,), with the version of the weights that chose it."""
        steps_until_next, version = self._next
        if steps_until_next == 0:
            self._version = version
        self._next = steps_until_next - 1, version
        self._steps.append(
            (np.array(action, np.float32), reward, success, self._version, self._instruction)
        )

    def finish(self) -> Trajectory:
        """Return the trajectory; if no action was executed, the shape of `actions` is (0, 0)."""
        actions, rewards, success, versions, instructions = (
            zip(*self._steps, strict=True) if self._steps else ((), (), (), (), ())
        )

        states = {}
        for name in self._states[0]:
            states[name] = np.stack([state[name] for state in self._states])

        has_gripper = self._grippers[0] is not None
        return Trajectory(
            np.stack(actions) if actions else np.zeros((0, 0), np.float32),
            np.array(rewards, np.float64),
            np.array(success, np.bool_),
            states,
            np.array(self._grippers, np.float32) if has_gripper else None,
            self._cameras,
            np.array(versions, np.int64),
            np.array(instructions, str),
        )


def videos_of(trajectory: Path, cameras: Iterable[str]) -> dict[str, Path]:
    """Return the paths of the MP4 files with the policy's images, by camera.

    Args:
        trajectory: The .npz file.
        cameras: The cameras of the trajectory.
    """
    return {
        camera: trajectory.with_name(f"{trajectory.stem}_{name}.mp4")
        for camera, name in distinct(cameras).items()
    }


def _shapes(state: Mapping[str, np.ndarray]) -> dict[str, tuple[int, ...]]:
    return {name: values.shape for name, values in sorted(state.items())}


@dataclass(frozen=True, slots=True)
class Artifacts:
    """The recorded files of an episode, which the worker sends to the driver with the result.

    An MP4 file has a frame for every observation.
    """

    videos: dict[str, bytes] = field(default_factory=dict)  # MP4 files for people, by camera
    # MP4 files of the policy's images, by camera
    policy_videos: dict[str, bytes] = field(default_factory=dict)
    trajectory: bytes | None = None  # a `Trajectory` as an .npz file
    transitions: Any = None  # a pyarrow.RecordBatch, for a learner


class EpisodeRecorder(EpisodeObserver):
    """The interface of a recorder for one episode. This class itself records nothing."""

    @property
    def needs_images(self) -> bool:
        """Whether the recorder needs the images of every step."""
        return False

    def finish(self, result: EpisodeResult) -> Artifacts:
        """Return the artifacts of the episode, which has this result."""
        return Artifacts()

    def close(self) -> None:
        """Free the recorder's resources."""


RecorderFactory = Callable[[float | None], EpisodeRecorder]  # the argument is the env's control_hz


class Recording(EpisodeRecorder):
    """Records a video and a trajectory of one episode, if the settings may choose the episode.

    An episode that may fail is recorded until it ends. If it does not fail, the recording is
    discarded.
    """

    def __init__(
        self,
        video: EpisodeChoice,
        trajectory: EpisodeChoice,
        fps: float | None,
        *,
        images: RecordedImages = "small",
    ) -> None:
        """Begin to record.

        Args:
            video: The choice of episodes with a video.
            trajectory: The choice of episodes with a trajectory.
            fps: The frames per second of the videos; None: `DEFAULT_FPS`.
            images: The images of trajectories: "small" uses the lossy videos, "exact" preserves
                each pixel.
        """
        self._wants_video = video
        self._wants_trajectory = trajectory
        self._video = VideoRecorder(fps)
        self._policy_video = self._video
        self._recorded_videos = [self._video]  # the video recorders in use
        if images == "exact" and trajectory != "none":
            self._policy_video = VideoRecorder(fps, lossless=True)
            self._recorded_videos = [self._policy_video]
            if video != "none":
                self._recorded_videos.append(self._video)
        self._trajectory = TrajectoryRecorder()

        self._observers: list[EpisodeObserver] = []
        if self.needs_images:
            self._observers += self._recorded_videos
        if self._wants_trajectory != "none":
            self._observers.append(self._trajectory)

    @property
    def needs_images(self) -> bool:
        """Whether a video or a trajectory may need the images of every step."""
        return self._wants_video != "none" or self._wants_trajectory != "none"

    def add_instruction(self, instruction: str) -> None:
        for observer in self._observers:
            observer.add_instruction(instruction)

    def add_observation(self, obs: Obs) -> None:
        for observer in self._observers:
            observer.add_observation(obs)

    def add_act(self, act: Act, ticks_waited: int = 0) -> None:
        for observer in self._observers:
            observer.add_act(act, ticks_waited)

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        for observer in self._observers:
            observer.add_action(action, reward, success)

    def finish(self, result: EpisodeResult) -> Artifacts:
        """Return the video and the trajectory of the episode, if the settings choose the
        episode.
        """
        wants_video = _is_chosen(self._wants_video, result)
        wants_trajectory = _is_chosen(self._wants_trajectory, result)
        if not wants_video and not wants_trajectory:
            return Artifacts()

        videos = self._video.finish()
        policy_videos = videos
        if self._policy_video is not self._video:
            policy_videos = self._policy_video.finish()
        trajectory = self._trajectory.finish().to_bytes() if wants_trajectory else None
        return Artifacts(
            videos if wants_video else {}, policy_videos if wants_trajectory else {}, trajectory
        )

    def close(self) -> None:
        for video in self._recorded_videos:
            video.close()


def save(
    out: Path, case: EvalCase, result: EpisodeResult, artifacts: Artifacts
) -> tuple[list[str], str | None]:
    """Write the files of an episode below `out`.

    A trajectory consists of `out/trajectories/POLICY/SUITE/ENV/epNNNN_seedS.npz` and its
    `_CAMERA.mp4` files. These are links to the videos for people if both are equal. The .npz file
    is written last: if it exists, all other files exist as well.

    Returns:
        The paths of the videos and of the trajectory, relative to `out`.
    """
    videos = save_videos(out, case, result, artifacts.videos)
    folder = _folder_for(out, storage.TRAJECTORIES, case, result)
    if artifacts.trajectory is None:
        return videos, None

    path = folder / f"{_stem(result)}.npz"
    video_of_camera = dict(zip(artifacts.videos, videos, strict=True))
    for camera, file in videos_of(path, artifacts.policy_videos).items():
        data = artifacts.policy_videos[camera]
        if artifacts.videos.get(camera) == data:
            storage.link_or_copy(out / video_of_camera[camera], file)
        else:
            with storage.whole(file) as unfinished_path:
                unfinished_path.write_bytes(data)

    with storage.whole(path) as unfinished_path:
        unfinished_path.write_bytes(artifacts.trajectory)
    return videos, str(path.relative_to(out))


def _is_chosen(choice: EpisodeChoice, result: EpisodeResult) -> bool:
    return choice == "all" or (choice == "failures" and not result.success_once)
