"""Reader of LeRobotDatasets v2.0 to v3.0: recordings of servers and robots, and public datasets."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.dataset_contract import (
    CHUNK,
    INFO,
    ROWS,
    SESSION,
    TRACE,
    DatasetContract,
    divided_state,
    state_parts,
)
from vlagents_ray.datasets.episode import (
    ACTION,
    ENVIRONMENT,
    IMAGES,
    INTERVENTION_COLUMN,
    SAFE_COLUMN,
    STATE,
    TICK_COLUMN,
)
from vlagents_ray.errors import ConfigError
from vlagents_ray.foreign_files import existing_file, fill_template, read_text
from vlagents_ray.images import jpeg_png
from vlagents_ray.images.mp4 import read_mp4, rgb_converter
from vlagents_ray.interface import CAPTURED, Obs
from vlagents_ray.naming import did_you_mean
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget
from vlagents_ray.protocol.values import from_text
from vlagents_ray.registry import require

_FOLDER = "the dataset"
_INFO_FILE = "meta/info.json"
_IMAGE_DTYPES = ("video", "image")


@dataclass(frozen=True, slots=True)
class Names:
    """The policy's names of the cameras and the state parts in a dataset without a contract."""

    # Name of the policy's camera -> camera or feature of the dataset.
    cameras: Mapping[str, str] = field(default_factory=dict)
    # Names of the parts that `observation.state` concatenates; "gripper" is `Obs.gripper`.
    state: Sequence[str] | None = None


@dataclass(frozen=True, slots=True)
class RecordedStep:
    """One frame of an episode."""

    frame: int
    obs: Obs
    # (H, D): the recorded answer, or else the actions from this frame to the end of the episode.
    expected: np.ndarray
    intervention: bool = False  # whether the operator chose the recorded action


@dataclass(frozen=True, slots=True)
class RecordedEpisode:
    """An episode of a dataset."""

    dataset: RecordedDataset
    index: int
    length: int
    instruction: str
    metadata: Mapping[str, Any]  # row of the episode in `meta/episodes`


@dataclass(frozen=True, slots=True)
class RecordedSession:
    """The episodes of one session in order; in a public dataset, a single episode."""

    episodes: tuple[RecordedEpisode, ...]
    options: Mapping[str, Any]  # options of the reset


class RecordedDataset:
    """A LeRobotDataset on disk, opened for reading."""

    def __init__(self, root: Path) -> None:
        """Open a dataset.

        Args:
            root: The folder of the dataset, which contains `meta/info.json`.

        Raises:
            ConfigError: The dataset cannot be read.
        """
        self.root = root
        self._pq: Any = require("pyarrow.parquet")

        self.info = _read_info(root / _INFO_FILE, self._text(_INFO_FILE))
        self.version = str(self.info.get("codebase_version"))
        if not self.version.startswith(("v3.", "v2.")):
            raise ConfigError(
                f"{root}: expected a LeRobotDataset v3.0, v2.1 or v2.0, got {self.version}; "
                "convert it"
            )
        self.features: dict[str, Any] = self.info.get("features") or {}
        if ACTION not in self.features:
            raise ConfigError(
                f"{root}: expected {ACTION!r} among its features, got {sorted(self.features)}"
            )
        contract = self.info.get(INFO)
        self.contract = None if contract is None else DatasetContract.from_json(contract)
        # Whether a server has recorded its sessions and the chunks that the policy returned.
        self.traced = TRACE in self.info and CHUNK in self.features

    @property
    def joints(self) -> list[str]:
        """The names of the values of an action."""
        names = self.features[ACTION].get("names")
        if isinstance(names, Mapping):  # {"motors": [...]}
            names = list(chain.from_iterable(names.values()))
        [dim] = self.features[ACTION]["shape"]
        if names and len(names) == dim:
            return [str(name) for name in names]
        return [f"{ACTION}_{i}" for i in range(dim)]

    @property
    def rows(self) -> int | None:
        """The number of rows of each forward pass of the recorded policy; None if it is unknown, or
        if the bits of its actions may depend on the batch.
        """
        passes = (self.info.get(TRACE) or {}).get("passes") or {}
        rows = passes.get("rows")
        return rows if isinstance(rows, int) else None

    @property
    def fps(self) -> float:
        """The rate of the frames, Hz."""
        return float(self.info["fps"])

    def sessions(self, chosen: Sequence[int] | None = None) -> list[RecordedSession]:
        """Return the sessions of the dataset.

        Args:
            chosen: The indices of their episodes; None selects all.

        Raises:
            ConfigError: A chosen episode does not exist.
        """
        episodes = self._episodes()
        if chosen is not None:
            missing = sorted(set(chosen) - {episode.index for episode in episodes})
            if missing:
                raise ConfigError(
                    f"{self.root}: expected only its {len(episodes)} episodes, got {missing}"
                )
            episodes = [episode for episode in episodes if episode.index in set(chosen)]
        if not self.traced:
            return [RecordedSession((episode,), {}) for episode in episodes]

        by_session: dict[int, list[RecordedEpisode]] = {}
        options: dict[int, str] = {}  # options of the session's first reset
        for episode in episodes:
            columns = self.columns(episode, [SESSION, "reset"])
            session = columns[SESSION][0]
            by_session.setdefault(session, []).append(episode)
            options.setdefault(session, columns["reset"][0])

        sessions = []
        for session, session_episodes in by_session.items():
            values = _read_values(options[session])
            sessions.append(RecordedSession(tuple(session_episodes), values))
        return sessions

    def gaps(self, episode: RecordedEpisode) -> int:
        """Return the number of calls that are missing within an episode of a server's recording."""
        if not self.traced:
            return 0
        ticks = np.array(self.columns(episode, [TICK_COLUMN])[TICK_COLUMN])
        return int((np.diff(ticks) - 1).clip(0).sum())

    def steps(
        self, episode: RecordedEpisode, names: Names, policy: Contract | None
    ) -> Iterator[RecordedStep]:
        """Yield the frames of an episode, with the policy's names of cameras and state parts.

        Args:
            episode: An episode of this dataset.
            names: The policy's names, which are used if the dataset has no contract.
            policy: The contract of the policy, which divides a state without names; None if the
                policy has no contract.

        Raises:
            ConfigError: A name is unknown, or a file is incomplete.
        """
        image_features = [
            name for name, feature in self.features.items() if feature["dtype"] in _IMAGE_DTYPES
        ]
        embedded = [name for name in image_features if self.features[name]["dtype"] == "image"]
        numeric = (ACTION, STATE, ENVIRONMENT, INTERVENTION_COLUMN, SAFE_COLUMN)
        column_names = [name for name in numeric if name in self.features] + embedded
        if self.traced:
            column_names += [CHUNK, ROWS, CAPTURED, "request"]
        columns = self.columns(episode, column_names)

        actions = np.array(columns[ACTION], np.float32).reshape(episode.length, -1)
        cameras = self._cameras(image_features, names)
        state_features = self._state_features(names, policy)
        videos = {name: self._video(episode, name) for name in cameras if name not in embedded}

        for i in range(episode.length):
            images = {}
            for feature, camera in cameras.items():
                if feature in videos:
                    image = next(videos[feature])
                else:
                    file = _embedded_file(columns[feature][i])
                    image = jpeg_png.decode(file, DEFAULT_LIMITS.pixels)
                images[camera] = self._original_size(image, camera)

            values = {}
            for name in state_features:
                values[name] = np.atleast_1d(np.array(columns[name][i], np.float32))
            state, gripper = divided_state(values, state_features)

            info: dict[str, Any] = {}
            expected = actions[i:]
            if self.traced:
                info = {CAPTURED: columns[CAPTURED][i], **_read_values(columns["request"][i])}
                chunk = np.array(columns[CHUNK][i], np.float32).reshape(-1, actions.shape[1])
                expected = chunk[: columns[ROWS][i]]

            intervention = INTERVENTION_COLUMN in columns and bool(columns[INTERVENTION_COLUMN][i])
            # Datasets of earlier releases also mark frames in which the guard rejected the
            # operator's action.
            rejected = SAFE_COLUMN in columns and bool(columns[SAFE_COLUMN][i])
            obs = Obs(images, gripper, state, info)
            yield RecordedStep(i, obs, expected, intervention and not rejected)

    def _episodes(self) -> list[RecordedEpisode]:
        """Read the episodes from the metadata, in the order of their indices."""
        rows: list[dict[str, Any]] = []
        if self.version.startswith("v2."):
            lines = self._text("meta/episodes.jsonl").splitlines()
            rows += [json.loads(line) for line in lines if line.strip()]
        else:
            for path in sorted(self.root.glob("meta/episodes/*/*.parquet")):
                name = path.relative_to(self.root).as_posix()
                with self._pq.ParquetFile(existing_file(self.root, name, _FOLDER)) as file:
                    all_names = file.schema_arrow.names
                    names = [name for name in all_names if not name.startswith("stats/")]
                    rows += file.read(names).to_pylist()
        rows.sort(key=lambda row: row["episode_index"])

        episodes = []
        for row in rows:
            episode = RecordedEpisode(
                dataset=self,
                index=row["episode_index"],
                length=row["length"],
                instruction=str(next(iter(row.get("tasks") or ()), "")),
                metadata=row,
            )
            episodes.append(episode)
        return episodes

    def columns(self, episode: RecordedEpisode, names: Sequence[str]) -> dict[str, list[Any]]:
        """Return columns of the rows of an episode; raises `ConfigError` if rows are missing."""
        file = self._file(episode, "data_path", "data")
        self._require_rows(file)
        filters = [("episode_index", "=", episode.index)]
        table = self._pq.read_table(file, columns=list(names), filters=filters)
        columns: dict[str, list[Any]] = table.to_pydict()
        if any(len(values) != episode.length for values in columns.values()):
            raise ConfigError(
                f"{file}: expected {episode.length} frames of episode {episode.index}, got another "
                "number; is the file complete?"
            )
        return columns

    def _text(self, path: str) -> str:
        return read_text(existing_file(self.root, path, _FOLDER))

    def _file(self, episode: RecordedEpisode, key: str, content: str, **names: str) -> Path:
        """Return the file with some content of an episode.

        Args:
            episode: The episode.
            key: The key of the path's template in `meta/info.json`.
            content: "data" for the rows of the episode, or "videos/FEATURE".
            names: Further fields of the template.
        """
        values: dict[str, str | int] = {**self._file_indices(episode, content), **names}
        path = fill_template(self.info[key], values, f"{self.root / _INFO_FILE}: {key}")
        return existing_file(self.root, path, _FOLDER)

    @cached_property
    def _frames(self) -> int:
        """The number of frames of all episodes."""
        return sum(episode.length for episode in self._episodes())

    def _require_rows(self, file: Path) -> None:
        """Raise `ConfigError` if a table has more rows than all episodes together: equal rows take
        no space in the file, but in memory.
        """
        with self._pq.ParquetFile(file) as table:
            rows = table.metadata.num_rows
        if rows > self._frames:
            raise ConfigError(
                f"{file}: expected at most the {self._frames} frames of the dataset, got {rows} "
                "rows; is it the file of another dataset?"
            )

    def _file_indices(self, episode: RecordedEpisode, content: str) -> dict[str, int]:
        """Return the numbers in the path of a file.

        Args:
            episode: The episode in the file.
            content: "data" for the rows of the episode, or "videos/FEATURE".
        """
        if self.version.startswith("v2."):
            chunk = episode.index // int(self.info["chunks_size"])
            return {"episode_index": episode.index, "episode_chunk": chunk}
        return {
            "chunk_index": episode.metadata[f"{content}/chunk_index"],
            "file_index": episode.metadata[f"{content}/file_index"],
        }

    def _video(self, episode: RecordedEpisode, feature: str) -> Iterator[np.ndarray]:
        """Yield the images of an episode, (H, W, 3) uint8 RGB."""
        file = self._file(episode, "video_path", f"videos/{feature}", video_key=feature)
        start_s = float(episode.metadata.get(f"videos/{feature}/from_timestamp") or 0)
        convert = rgb_converter()
        with read_mp4(file, DEFAULT_LIMITS.pixels) as container:
            [stream, *_] = container.streams.video
            if start_s:
                container.seek(int(start_s / stream.time_base), stream=stream)
            for frame in container.decode(stream):
                if frame.time >= start_s - 0.5 / self.info["fps"]:
                    yield convert(frame)
        raise ConfigError(
            f"{file}: has fewer than the {episode.length} frames of episode {episode.index}"
        )

    def _original_size(self, image: np.ndarray, camera: str) -> np.ndarray:
        """Remove the row or column that was added to an image to make its height and width even, as
        video codecs need.
        """
        cameras = {} if self.contract is None else self.contract.contract.cameras or {}
        spec = cameras.get(camera)
        if spec is None or spec.height is None or spec.width is None:
            return image
        return np.ascontiguousarray(image[: spec.height, : spec.width])

    def _cameras(self, image_features: Sequence[str], names: Names) -> dict[str, str]:
        """Return the policy's name of each camera, by the feature that contains the camera's
        images.

        Args:
            image_features: The features of the dataset that contain images.
            names: The policy's names; if they contain no cameras, the dataset's camera names are
                used.

        Raises:
            ConfigError: The dataset lacks a camera or feature that `names` contains.
        """
        contract_names = {} if self.contract is None else self.contract.cameras
        dataset_names = {}
        for feature in image_features:
            dataset_names[feature] = contract_names.get(feature, feature.removeprefix(IMAGES))
        if not names.cameras:
            return dataset_names

        # The user may write the dataset's name of the camera, or the name of the feature.
        features = {camera: feature for feature, camera in dataset_names.items()}
        features |= {feature: feature for feature in image_features}
        unknown = [name for name in names.cameras.values() if name not in features]
        if unknown:
            raise ConfigError(
                f"--camera-map: expected only {sorted(dataset_names.values())} of {self.root}, got "
                f"{unknown[0]!r}{did_you_mean(unknown[0], features)}"
            )
        return {features[name]: camera for camera, name in names.cameras.items()}

    def _state_features(
        self, names: Names, policy: Contract | None
    ) -> dict[str, list[tuple[str, int]]]:
        """Return the names and sizes of the parts of each state feature, in order.

        Args:
            names: The policy's names.
            policy: The contract of the policy, which divides a state without names, or None.
        """
        widths = {}
        for feature in (STATE, ENVIRONMENT):
            if feature in self.features:
                widths[feature] = int(self.features[feature]["shape"][0])

        features: dict[str, list[tuple[str, int]]] = {}
        if self.contract is not None and names.state is None:
            orders = {STATE: self.contract.state, ENVIRONMENT: self.contract.environment}
            specs = self.contract.contract.state or {}
            sizes = {name: int(spec.dim or 0) for name, spec in specs.items()}
            for feature in widths:
                # The only name that the contract's state lacks is "gripper", which has one value.
                features[feature] = [(name, sizes.get(name, 1)) for name in orders[feature]]
            return features

        if ENVIRONMENT in widths:
            features[ENVIRONMENT] = [(ENVIRONMENT.rpartition(".")[2], widths[ENVIRONMENT])]
        if STATE in widths:
            features[STATE] = state_parts(
                widths[STATE], policy, names.state, option="--state joints,gripper"
            )
        return features


def _read_info(file: Path, text: str) -> dict[str, Any]:
    """Return the description of a dataset in the text of a file; raises `ConfigError` if it is not
    a JSON object.
    """
    try:
        info = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(
            f"{file}: expected JSON, got an error, {error}; is the file complete?"
        ) from error
    if not isinstance(info, dict):
        raise ConfigError(f"{file}: expected a JSON object, got {type(info).__name__}")
    return info


def _embedded_file(value: Mapping[str, Any]) -> bytes:
    """Return the JPEG or PNG file that the table contains as an image."""
    data = value.get("bytes")
    if not data:
        raise ConfigError(
            f"expected the bytes of an image in the table, got a path, {value.get('path')!r}; "
            "LeRobot embeds images"
        )
    return bytes(data)


def _read_values(text: str) -> dict[str, Any]:
    """Read a mapping from the text of a column; an empty text is an empty mapping."""
    return dict(from_text(text, Budget(DEFAULT_LIMITS))) if text else {}
