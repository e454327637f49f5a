"""Recorded episodes as one MCAP file, for Foxglove and other programs that read MCAP.

Messages are JSON with a JSON schema, and images are `foxglove.CompressedImage`. A JPEG or PNG file
of a dataset is written unchanged; frames of videos are encoded as JPEG.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.datasets.episode import (
    ACTION,
    INTERVENTION_COLUMN,
    OUTCOMES,
    WANTED_ACTION,
)
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.recorder import DEFAULT_FPS, Trajectory, videos_of
from vlagents_ray.evaluate.artifacts.storage import require_folder_of, require_there, whole
from vlagents_ray.evaluate.results.reader import CaseResults, Episode, Results
from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.images.mp4 import rgb_converter
from vlagents_ray.naming import did_you_mean
from vlagents_ray.recorded_dataset import Names, RecordedDataset, RecordedEpisode
from vlagents_ray.registry import require
from vlagents_ray_results.recorded import recorded_episodes

DISTRIBUTION = "vlagents-ray-results"
_JPEG_MAGIC = b"\xff\xd8\xff"
_PAUSE_NS = 1_000_000_000  # time between episodes that would otherwise overlap
_NS_PER_S = 1_000_000_000

_TIME = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": {"type": "integer", "minimum": 0},
        "nsec": {"type": "integer", "minimum": 0, "maximum": _NS_PER_S - 1},
    },
}
_IMAGE_PROPERTIES = {
    "timestamp": _TIME,
    "frame_id": {"type": "string"},
    "data": {"type": "string", "contentEncoding": "base64"},
    "format": {"type": "string"},
}
_VALUES_PROPERTIES = {
    "timestamp": _TIME,
    "names": {"type": "array", "items": {"type": "string"}},
    "values": {"type": "array", "items": {"type": "number"}},
}
_OUTCOME_PROPERTIES = {
    "timestamp": _TIME,
    "reward": {"type": "number"},
    "success": {"type": "boolean"},
    "done": {"type": "boolean"},
}
_EPISODE_PROPERTIES = {
    "timestamp": _TIME,
    "episode": {"type": "string"},
    "instruction": {"type": "string"},
    "frames": {"type": "integer"},
}
# The schemas by name; the schema of images is Foxglove's own.
_SCHEMAS: dict[str, Mapping[str, Any]] = {
    "foxglove.CompressedImage": _IMAGE_PROPERTIES,
    "vlagents_ray.Values": _VALUES_PROPERTIES,
    "vlagents_ray.Outcome": _OUTCOME_PROPERTIES,
    "vlagents_ray.Episode": _EPISODE_PROPERTIES,
}


@dataclass(frozen=True, slots=True)
class EpisodeStart:
    """The description of an episode, which is written before its frames."""

    name: str
    instruction: str
    start_ns: int  # start time, ns since 1970, or from 0 if the time is not known
    frames: int
    about: Mapping[str, str]  # the content of the episode's MCAP metadata


class McapFile:
    """Writes the messages of episodes, one episode after the other.

    The topics are `/camera/NAME`, `/state/NAME`, `/action`, `/outcome` and `/episode`. The outcome
    of an action has the time of the next frame.

    Args:
        writer: A started `mcap.writer.Writer`.
        quality: The quality of JPEG images, in [1, 100].
    """

    def __init__(self, writer: Any, quality: int) -> None:
        self.prefix = ""  # prefix of the topics of the following messages
        self._writer = writer
        self._quality = quality
        self._schemas: dict[str, int] = {}  # numbers of schemas by name
        self._channels: dict[str, int] = {}  # numbers of channels by topic

    def begin(self, episode: EpisodeStart) -> None:
        """Begin an episode."""
        self._writer.add_metadata(f"episode {episode.name}", dict(episode.about))
        content = {
            "episode": episode.name,
            "instruction": episode.instruction,
            "frames": episode.frames,
        }
        self._add("/episode", "vlagents_ray.Episode", episode.start_ns, content)

    def add_image(self, camera: str, time_ns: int, image: np.ndarray | bytes) -> None:
        """Write an image, (H, W, 3) uint8 RGB, or the bytes of a JPEG or PNG file."""
        data = encode_jpeg(image, self._quality) if isinstance(image, np.ndarray) else image
        content = {
            "frame_id": camera,
            "data": base64.b64encode(data).decode(),
            "format": "jpeg" if data.startswith(_JPEG_MAGIC) else "png",
        }
        self._add(f"/camera/{camera}", "foxglove.CompressedImage", time_ns, content)

    def add_values(
        self, topic: str, time_ns: int, values: np.ndarray, names: Sequence[str] = ()
    ) -> None:
        """Write numbers, (D,), with their names if they are known."""
        numbers = [_json_number(value) for value in np.asarray(values, np.float64)]
        content = {"names": list(names), "values": numbers}
        self._add(topic, "vlagents_ray.Values", time_ns, content)

    def add_outcome(self, time_ns: int, *, reward: float, success: bool, done: bool) -> None:
        """Write the outcome of an action."""
        content = {
            "reward": _json_number(reward),
            "success": bool(success),
            "done": bool(done),
        }
        self._add("/outcome", "vlagents_ray.Outcome", time_ns, content)

    def _add(self, topic: str, schema: str, time_ns: int, content: Mapping[str, Any]) -> None:
        """Write a message, and describe its topic before its first message."""
        topic = self.prefix + topic
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="json", schema_id=self._schema(schema)
            )
        sec, nsec = divmod(time_ns, _NS_PER_S)
        message = {"timestamp": {"sec": sec, "nsec": nsec}, **content}
        self._writer.add_message(
            channel_id=self._channels[topic],
            log_time=time_ns,
            publish_time=time_ns,
            data=json.dumps(message, allow_nan=False).encode(),
        )

    def _schema(self, name: str) -> int:
        """Return the number of a schema, which is written before its first use."""
        if name not in self._schemas:
            document = {"title": name, "type": "object", "properties": _SCHEMAS[name]}
            self._schemas[name] = self._writer.register_schema(
                name=name, encoding="jsonschema", data=json.dumps(document).encode()
            )
        return self._schemas[name]


def _json_number(value: float) -> float | None:
    """Return a number for JSON; None in place of NaN and infinity, which JSON lacks."""
    return float(value) if math.isfinite(value) else None


@contextmanager
def _new_file(path: Path, quality: int) -> Iterator[McapFile]:
    """Yield a file for writing, which is renamed to its final name when it is complete.

    Raises:
        ConfigError: `quality` is not a quality of JPEG.
        MissingDependency: The package `mcap` is not installed.
    """
    if not 1 <= quality <= 100:
        raise ConfigError(f"quality: expected a number from 1 to 100, got {quality}")
    module: Any = require("mcap.writer", extra="mcap", distribution=DISTRIBUTION)
    require_folder_of(path)
    with whole(path) as unfinished, unfinished.open("wb") as stream:
        writer = module.Writer(stream)
        writer.start(profile="", library="vlagents_ray")
        yield McapFile(writer, quality)
        writer.finish()


def results_to_mcap(
    results: Results, path: Path, *, cameras: Sequence[str] | None = None, quality: int = 90
) -> int:
    """Write the recorded trajectories of an evaluation as one MCAP file.

    The frames of an episode follow each other at the control rate; the last frame has the time at
    which the episode was recorded. Episodes that ran in parallel are written one after the other,
    with a second between them.

    Args:
        results: The results.
        path: The file.
        cameras: The cameras of the file; by default all.
        quality: The quality of JPEG images, in [1, 100].

    Returns:
        The number of episodes.

    Raises:
        ConfigError: There is no such trajectory, a file is missing, or a camera is unknown.
    """
    recorded = recorded_episodes(results)
    recorded.sort(key=lambda case_and_episode: case_and_episode[1].finished)

    end_ns = 0
    with _new_file(path, quality) as file:
        for case, episode in recorded:
            end_ns = _write_trajectory(file, results, case, episode, cameras, after_ns=end_ns)
    return len(recorded)


def _write_trajectory(
    file: McapFile,
    results: Results,
    case: CaseResults,
    episode: Episode,
    cameras: Sequence[str] | None,
    *,
    after_ns: int,
) -> int:
    """Write one recorded episode after the time `after_ns`, and return the time of its end, ns."""
    trajectory_path = Path(str(episode.trajectory))
    trajectory = Trajectory.load(results.file(str(trajectory_path)))
    fps = float(case.contract.get("control_hz") or DEFAULT_FPS)
    steps = len(trajectory.actions)

    began_ns = round((episode.finished - steps / fps) * _NS_PER_S)
    start_ns = max(began_ns, after_ns + _PAUSE_NS)
    times = [start_ns + round(i * _NS_PER_S / fps) for i in range(steps + 1)]
    result = episode.result
    about = {
        "policy": case.policy_id,
        "env": case.env,
        "suite": case.suite or "",
        "seed": str(result.key.seed),
        "success_once": json.dumps(result.success_once),
        "status": result.status,
    }
    file.begin(EpisodeStart(result.full_key, result.instruction, start_ns, len(times), about))

    for name, values in trajectory.state.items():
        for time_ns, row in zip(times, values, strict=True):
            file.add_values(f"/state/{name}", time_ns, row)
    if trajectory.gripper is not None:
        for time_ns, opening in zip(times, trajectory.gripper, strict=True):
            file.add_values("/state/gripper", time_ns, np.array([opening]))

    for i in range(steps):
        file.add_values("/action", times[i], trajectory.actions[i])
        file.add_outcome(
            times[i + 1],
            reward=trajectory.rewards[i],
            success=trajectory.success[i],
            done=i == steps - 1,
        )

    chosen = _chosen_cameras(cameras, trajectory.cameras)
    for camera, video in videos_of(trajectory_path, trajectory.cameras).items():
        if camera not in chosen:
            continue
        images = _frames_of(require_there(results.file(str(video))))
        for time_ns, image in zip(times, islice(images, len(times)), strict=True):
            file.add_image(camera, time_ns, image)
    return times[-1]


def _frames_of(video: Path) -> Iterator[np.ndarray]:
    """Yield the images of a video, (H, W, 3) uint8 RGB."""
    convert = rgb_converter()
    with require("av").open(str(video)) as container:
        for frame in container.decode(container.streams.video[0]):
            yield convert(frame)


def _chosen_cameras(names: Sequence[str] | None, known: Iterable[str]) -> list[str]:
    """Return the cameras that an option chooses, by default all.

    Raises:
        ConfigError: A camera is unknown.
    """
    known = list(known)
    if names is None:
        return known
    for name in names:
        if name not in known:
            raise ConfigError(
                f"cameras: expected only {sorted(known)}, got {name!r}{did_you_mean(name, known)}"
            )
    return list(names)


def dataset_to_mcap(
    folder: Path, path: Path, *, cameras: Sequence[str] | None = None, quality: int = 90
) -> int:
    """Write a LeRobotDataset, such as the recording of a robot or of a server, as one MCAP file.

    A frame has the time at which it was captured. In a dataset without these times, frames begin at
    0 and follow at the dataset's rate. The sessions of a server's recording, which ran at the same
    time, have separate topics, such as `/session_0/action`.

    Args:
        folder: The folder of the dataset, or of several datasets.
        path: The file.
        cameras: The cameras of the file; by default all.
        quality: The quality of the JPEG images that are encoded from videos, in [1, 100].

    Returns:
        The number of episodes.

    Raises:
        ConfigError: A dataset cannot be read, or a camera is unknown.
    """
    files = [*sorted(folder.glob("meta/info.json")), *sorted(folder.glob("*/meta/info.json"))]
    datasets = [RecordedDataset(info_file.parents[1]) for info_file in files]
    sessions = []
    for dataset in datasets:
        sessions += [(dataset, session) for session in dataset.sessions()]
    is_parallel = len(sessions) > 1 and any(dataset.traced for dataset in datasets)

    episodes = 0
    end_ns = -_PAUSE_NS
    with _new_file(path, quality) as file:
        for number, (dataset, session) in enumerate(sessions):
            file.prefix = f"/session_{number}" if is_parallel else ""
            for episode in session.episodes:
                end_ns = _write_episode(file, dataset, episode, cameras, after_ns=end_ns)
                episodes += 1
    return episodes


def _write_episode(
    file: McapFile,
    dataset: RecordedDataset,
    episode: RecordedEpisode,
    cameras: Sequence[str] | None,
    *,
    after_ns: int,
) -> int:
    """Write one episode of a dataset, and return the time of its end, ns.

    If its frames have no time, the episode begins after the time `after_ns`.
    """
    optional = (*OUTCOMES, WANTED_ACTION, INTERVENTION_COLUMN)
    names = [ACTION, *(name for name in optional if name in dataset.features)]
    columns = dataset.columns(episode, names)
    frame_ns = _NS_PER_S / dataset.fps
    start_ns = after_ns + _PAUSE_NS
    time_ns = start_ns

    for i, step in enumerate(dataset.steps(episode, Names(), None)):
        if step.captured_at is None:
            time_ns = start_ns + round(i * frame_ns)
        else:
            time_ns = round(step.captured_at * _NS_PER_S)
        if i == 0:
            name = f"{dataset.root.name}#{episode.index}"
            about = {"dataset": str(dataset.root), "index": str(episode.index)}
            file.begin(EpisodeStart(name, episode.instruction, time_ns, episode.length, about))

        for camera in _chosen_cameras(cameras, step.obs.cameras):
            image = step.image_files.get(camera, step.obs.cameras[camera])
            file.add_image(camera, time_ns, image)
        for part, values in step.obs.state.items():
            file.add_values(f"/state/{part}", time_ns, values)
        if step.obs.gripper is not None:
            file.add_values("/state/gripper", time_ns, np.array([step.obs.gripper]))

        action = np.atleast_1d(columns[ACTION][i])
        file.add_values("/action", time_ns, action, dataset.joints)
        if WANTED_ACTION in columns:
            policy_action = np.atleast_1d(columns[WANTED_ACTION][i])
            file.add_values("/policy_action", time_ns, policy_action, dataset.joints)
        if INTERVENTION_COLUMN in columns:
            file.add_values("/intervention", time_ns, np.array([step.intervention]))
        if all(name in columns for name in OUTCOMES):
            reward, success, done = (columns[name][i] for name in OUTCOMES)
            outcome_ns = time_ns + round(frame_ns)
            file.add_outcome(outcome_ns, reward=reward, success=success, done=done)
    return time_ns
