"""Writes recorded trajectories as a LeRobotDataset v3.0, for viewing and for training."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract, StateSpec
from vlagents_ray.dataset_contract import (
    GRIPPER,
    Centre,
    DatasetContract,
    angles_in,
    centre_of,
    rotation_centre_of,
    rotation_vector_in,
)
from vlagents_ray.datasets.episode import (
    ACTION,
    ENVIRONMENT,
    INDEX,
    OUTCOMES,
    STATE,
    FinishedEpisode,
    ImageStatistics,
    Stats,
    camera_keys,
    number_features,
    outcome_rows,
    parts_of,
    state_vector,
    vector_feature,
    video_feature,
    without_slash,
)
from vlagents_ray.datasets.writer import UNFINISHED_FOLDER, Dataset
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.recorder import DEFAULT_FPS, Trajectory, videos_of
from vlagents_ray.evaluate.artifacts.storage import link_or_copy, require_there
from vlagents_ray.evaluate.results.reader import CaseResults, Episode, Results
from vlagents_ray.images.mp4 import read_mp4, rgb_converter
from vlagents_ray.naming import did_you_mean, distinct
from vlagents_ray.protocol.messages import DEFAULT_LIMITS

GRIPPER_FEATURE = "observation.gripper"
VERSION = "policy_version"


def to_lerobot(
    results: Results,
    path: Path,
    *,
    cameras: Sequence[str] | None = None,
    state: Sequence[str] | None = None,
    environment_state: Sequence[str] = (),
    successes: bool = False,
    cut_idle: bool = False,
) -> int:
    """Write the recorded episodes as a LeRobotDataset v3.0 into the new folder `path`, or write
    nothing.

    One episode at a time is in memory.

    A frame is an observation and the action after it; the last observation of an episode is left
    out. Angles and rotation vectors of the state that jump by a full turn are written relative to
    another centre. The dataset's contract (`vlagents_ray.dataset_contract`) names the centre, so
    that the policy's server converts them in the same way. If a policy reported the version of its
    weights, each frame has the version that chose its action, or -1 if it is unknown.

    Args:
        cameras: The cameras of the dataset; by default all.
        state: The parts of `observation.state` in this order, "gripper" for `Obs.gripper`; by
            default all that are not in `environment_state`, sorted, the gripper last.
        environment_state: The parts of `observation.environment_state` in this order: LeRobot's
            policies need this feature if they have no camera.
        successes: Leave out episodes in which the task was never solved.
        cut_idle: End each episode when neither state nor action changes any more after the task was
            solved.

    Returns:
        The number of episodes in the dataset.

    Raises:
        ConfigError: There is no such trajectory, a file is missing, a camera or part is unknown, or
            the episodes do not fit one dataset.
    """
    recorded = _recorded_episodes(results)

    if successes:
        solved = [(case, episode) for case, episode in recorded if episode.result.success_once]
        if not solved:
            raise ConfigError(
                f"{results.out}: in none of the {len(recorded)} recorded episodes was the task "
                "solved"
            )
        recorded = solved

    if path.exists() and any(path.iterdir()):
        raise ConfigError(
            f"{path}: expected a new or empty folder, got one with files; export into a new folder"
        )
    rates = {_fps(case) for case, _ in recorded}
    if len(rates) > 1:
        raise ConfigError(
            f"the envs run at {sorted(rates)} Hz, and a dataset has one rate; {_CURE}"
        )

    with_versions = any(episode.result.policy_version is not None for _, episode in recorded)
    selection = _Selection(results, cameras, state, environment_state, cut_idle, with_versions)
    angles = _angles(selection.demonstrations(recorded))

    with _new_folder(path) as root:
        dataset = Dataset(root, rates.pop(), durable=False)
        for demonstration in selection.demonstrations(recorded):
            finished = _finished(demonstration, angles, root / UNFINISHED_FOLDER)
            features = dataset.info["features"]
            if dataset.episodes and finished.features != features:
                differing = sorted(
                    key for key, value in finished.features.items() if features.get(key) != value
                )
                env = demonstration.case.env
                raise ConfigError(
                    f"{env}: has other features than the envs before it ({', '.join(differing)}); "
                    f"{_CURE}"
                )
            dataset.save(finished)

        if not dataset.episodes:
            raise ConfigError(
                f"{results.out}: in none of the {len(recorded)} recorded episodes did the policy "
                "act"
            )

        shutil.rmtree(root / UNFINISHED_FOLDER, ignore_errors=True)
        return dataset.episodes


def _recorded_episodes(results: Results) -> list[tuple[CaseResults, Episode]]:
    """Return each episode that has a trajectory, with its case.

    Raises:
        ConfigError: No episode has a trajectory.
    """
    recorded = []
    for case in results.cases:
        recorded += [(case, episode) for episode in case.episodes if episode.trajectory is not None]
    if not recorded:
        raise ConfigError(
            f"{results.out}: expected trajectories, got none; evaluate with --record all "
            "(`record: all` in its file)"
        )
    return recorded


_CURE = "export env by env (--env)"
# Share of the range of a part of the state, or of the action, below which changes between frames
# count as rest.
_STILL = 0.01


@dataclass(frozen=True, slots=True)
class _Demonstration:
    """The N frames of one episode that go into the dataset."""

    case: CaseResults
    contract: Contract  # contract of the environment
    actions: np.ndarray  # (N, A) actions
    rewards: np.ndarray  # (N,)
    success: np.ndarray  # (N,)
    instructions: np.ndarray  # (N,) text
    parts: tuple[str, ...]  # parts of `observation.state`
    environment: tuple[str, ...]  # parts of `observation.environment_state`
    state: dict[str, np.ndarray]  # (N, D) values of each part
    gripper: np.ndarray | None  # (N,)
    # (N,) versions of the weights that chose each action; None if no episode's policy reported
    # them.
    versions: np.ndarray | None
    videos: dict[str, Path]  # the video of each camera


@dataclass(frozen=True, slots=True)
class _Selection:
    """The cameras, parts of the state and frames of recorded episodes that go into the dataset."""

    results: Results
    cameras: Sequence[str] | None
    state: Sequence[str] | None
    environment_state: Sequence[str]
    cut_idle: bool
    with_versions: bool  # whether frames have the version of the weights

    def demonstrations(
        self, recorded: Iterable[tuple[CaseResults, Episode]]
    ) -> Iterator[_Demonstration]:
        """Yield the recorded episodes one after the other, except episodes without frames."""
        for case, episode in recorded:
            demonstration = self._read(case, episode)
            # A policy that failed before it acted leaves an empty episode.
            if len(demonstration.actions):
                yield demonstration

    def _read(self, case: CaseResults, episode: Episode) -> _Demonstration:
        path = str(episode.trajectory)
        trajectory = Trajectory.load(self.results.file(path))
        parts = parts_of(trajectory.state, trajectory.gripper is not None)
        vectors = [name for name in parts if name != GRIPPER or trajectory.gripper is None]
        environment = _chosen("environment_state", self.environment_state, vectors, case.env)
        state_option = self.state
        if state_option is None:
            state_option = [name for name in parts if name not in environment]
        chosen = _chosen("state", state_option, parts, case.env)
        cameras = _chosen("cameras", self.cameras, trajectory.cameras, case.env)
        videos = videos_of(Path(path), trajectory.cameras)

        gripper = trajectory.gripper if GRIPPER in chosen else None
        in_state = {*chosen, *environment}
        if gripper is not None:
            in_state.remove(GRIPPER)
        state = {name: values for name, values in trajectory.state.items() if name in in_state}

        frames = len(trajectory.actions)
        if self.cut_idle:
            moving = [trajectory.actions, *state.values()]
            if gripper is not None:
                moving.append(gripper[:, np.newaxis])
            frames = _frames_until_rest(trajectory.success, moving)

        return _Demonstration(
            case,
            Contract.from_json(case.contract),
            trajectory.actions[:frames],
            trajectory.rewards[:frames],
            trajectory.success[:frames],
            trajectory.instructions[:frames],
            tuple(chosen),
            tuple(environment),
            {name: values[:frames] for name, values in state.items()},
            None if gripper is None else gripper[:frames],
            trajectory.versions[:frames] if self.with_versions else None,
            {camera: require_there(self.results.file(str(videos[camera]))) for camera in cameras},
        )


@contextmanager
def _new_folder(path: Path) -> Iterator[Path]:
    """Yield a folder for writing, which is renamed to `path` when it is complete; `path` must be
    missing or empty.

    Until then the folder is next to `path`; it is removed if writing fails.
    """
    path = path.resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{path.name}.part-", dir=path.parent) as temporary:
        unfinished = Path(temporary) / path.name
        unfinished.mkdir()
        yield unfinished
        os.sync()  # one sync for all files of the folder
        os.replace(unfinished, path)


def _fps(case: CaseResults) -> float:
    return float(case.contract.get("control_hz") or DEFAULT_FPS)


def _chosen(option: str, names: Sequence[str] | None, known: Sequence[str], env: str) -> list[str]:
    """Return the names that an option chooses, by default all known names.

    Raises:
        ConfigError: A name is unknown, or occurs twice.
    """
    if names is None:
        return list(known)

    unknown = [name for name in names if name not in known]
    if unknown:
        raise ConfigError(
            f"{option}: {env}: expected only {sorted(known)}, got "
            f"{', '.join(map(repr, unknown))}{did_you_mean(unknown[0], known)}"
        )
    if len(set(names)) < len(names):
        raise ConfigError(f"{option}: expected each name once, got {list(names)}")
    return list(names)


def _frames_until_rest(success: np.ndarray, moving: Sequence[np.ndarray]) -> int:
    """Return the number of frames until the robot is at rest after success; all frames without
    success.

    One frame at rest is kept, so that the policy learns to stop.
    """
    frames = len(success)
    if not success.any():
        return frames

    last = int(success.argmax())  # the frame whose action solved the task
    for values in moving:
        steps = np.abs(np.diff(values, axis=0)).max(axis=1, initial=0)
        moved = np.flatnonzero(steps > _STILL * np.ptp(values, axis=0).max(initial=0))
        last = max(last, int(moved.max(initial=0)))
    return min(last + 2, frames)


def _angles(demonstrations: Iterable[_Demonstration]) -> dict[int, Centre]:
    """Return the indices in `observation.state` of angles and rotation vectors that jump, with
    their centres.
    """
    angles: dict[int, list[np.ndarray]] = {}  # values by index; each (N,)
    # Rotation vectors by the index of the first number; each (N, 3)
    vectors: dict[int, list[np.ndarray]] = {}
    for demonstration in demonstrations:
        index = 0
        for name in demonstration.parts:
            values = demonstration.state.get(name)  # None for the gripper, which is one number
            spec = (demonstration.contract.state or {}).get(name)
            if values is not None and spec is not None:
                dim = values.shape[1]
                for i in angles_in(name, spec.unit, dim):
                    angles.setdefault(index + i, []).append(values[:, i])
                first = rotation_vector_in(name, spec.unit, dim)
                if first is not None:
                    vectors.setdefault(index + first, []).append(values[:, first : first + 3])
            index += 1 if values is None else values.shape[1]

    centres: dict[int, Centre | None] = {
        index: centre_of(episodes) for index, episodes in angles.items()
    }
    centres |= {index: rotation_centre_of(episodes) for index, episodes in vectors.items()}
    return {index: centre for index, centre in centres.items() if centre is not None}


def _finished(
    demonstration: _Demonstration, angles: Mapping[int, Centre], folder: Path
) -> FinishedEpisode:
    """Return the episode in the dataset's form, and write its videos into `folder`."""
    keys = camera_keys(demonstration.videos)
    names = {key: camera for camera, key in keys.items()}
    env = demonstration.contract

    cameras = {}
    for camera in demonstration.videos:
        cameras[camera] = (env.cameras or {}).get(camera, CameraSpec())
    state = {}
    for name, values in demonstration.state.items():
        spec = (env.state or {}).get(name, StateSpec())
        state[name] = replace(spec, dim=values.shape[1])
    # The contract of a policy that is trained on the dataset: its actions are those of the
    # environment, without bounds.
    contract = Contract(
        cameras=cameras,
        state=state,
        gripper=demonstration.gripper is not None,
        action=replace(env.action, dim=demonstration.actions.shape[1], low=None, high=None),
        control_hz=env.control_hz,
    )
    about = DatasetContract(contract, demonstration.parts, names, angles, demonstration.environment)
    rows, features = _numbers(demonstration, about)

    images: dict[str, Stats] = {}
    videos: dict[str, Path] = {}
    for camera, video in demonstration.videos.items():
        key = keys[camera]
        statistics = ImageStatistics()
        convert = rgb_converter()
        with read_mp4(video, DEFAULT_LIMITS.pixels) as container:
            stream = container.streams.video[0]
            for frame in islice(container.decode(stream), len(demonstration.actions)):
                statistics.add(convert(frame))
            images[key] = statistics.result()
            pixels = stream.codec_context.pix_fmt  # "gbrp" if the recording is lossless
            features[key] = video_feature(
                stream.height, stream.width, _fps(demonstration.case), pixels
            )
        videos[key] = folder / f"{key}.mp4"
        link_or_copy(video, videos[key])

    return FinishedEpisode(
        demonstration.instructions.tolist(), features, rows, images, videos, about
    )


def _numbers(
    demonstration: _Demonstration, about: DatasetContract
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return rows and features: the state as one vector and as separate parts, the action, and the
    action's outcome.
    """
    dim = demonstration.actions.shape[1]
    together, names = state_vector(demonstration.state, demonstration.gripper, demonstration.parts)
    together = about.wrapped(together)
    rows: dict[str, Any] = {
        ACTION: demonstration.actions,
        **outcome_rows(demonstration.rewards, demonstration.success),
    }
    features = {
        ACTION: vector_feature([f"action_{i}" for i in range(dim)]),
        **number_features(OUTCOMES | INDEX),
    }
    features[ACTION]["spec"] = demonstration.case.contract.get("action")
    if names:
        rows[STATE] = together
        features[STATE] = vector_feature(names)
    if demonstration.environment:
        rows[ENVIRONMENT], names = state_vector(
            demonstration.state, None, demonstration.environment
        )
        features[ENVIRONMENT] = vector_feature(names)
    if demonstration.versions is not None:
        rows[VERSION] = demonstration.versions
        features |= number_features({VERSION: "int64"})

    vectors = [name for name in demonstration.parts if name in demonstration.state]
    keys = distinct(vectors, without_slash)
    specs = demonstration.contract.state or {}
    index = 0
    for name in demonstration.parts:
        if name not in demonstration.state:
            rows[GRIPPER_FEATURE] = demonstration.gripper
            features |= number_features({GRIPPER_FEATURE: "float32"})
            index += 1
            continue

        width = demonstration.state[name].shape[1]
        key = f"{STATE}.{keys[name]}"
        rows[key] = together[:, index : index + width]
        features[key] = vector_feature([f"{name}_{i}" for i in range(width)])
        features[key]["unit"] = getattr(specs.get(name), "unit", None)
        index += width
    return rows, features
