"""A LeRobotDataset v3.0 on disk: Parquet and MP4 files, written one episode at a time.

The layout, names and columns are the same as in LeRobot 0.4.4 (`lerobot/datasets/utils.py`,
`lerobot_dataset.py`). LeRobot may put many episodes into a file; here each episode has its own
files, so that it is either complete or absent. Files receive their final names when they are
complete, `meta/info.json` last. Files of an episode that `info.json` does not count are removed
when the dataset is opened again, or when the episode could not be saved.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec
from vlagents_ray.dataset_contract import INFO, STATISTICS
from vlagents_ray.datasets.episode import (
    ACTION,
    INTERVENTION_COLUMN,
    FinishedEpisode,
    RunningEpisode,
    Stats,
    joined,
    of_values,
)
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

VERSION = "v3.0"
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA, VIDEO, EPISODES = (
    f"data/{FILE}.parquet",
    f"videos/{{video_key}}/{FILE}.mp4",
    f"meta/episodes/{FILE}.parquet",
)
FILES_IN_CHUNK = 1000
UNFINISHED_FOLDER = "unfinished"  # name of the folder of the running episodes in a dataset


class Dataset:
    """A dataset to which episodes are added.

    Opening an existing dataset continues it with the same columns.
    """

    def __init__(
        self,
        root: Path,
        fps: float,
        *,
        interventions: bool = False,
        lossless: bool = False,
        durable: bool = True,
    ) -> None:
        """Open or create a dataset of frames at `fps` Hz.

        With `lossless`, videos keep each pixel unchanged. With `durable`, an episode is on the disk
        when `save` returns.

        Raises:
            ConfigError: The folder contains other files, or a dataset with another rate or version.
            MissingDependency: The extra "record" is not installed.
        """
        self.root = root
        self.interventions = interventions
        self._lossless = lossless
        self._durable = durable
        self._pq: Any = require("pyarrow.parquet")
        self._pa: Any = require("pyarrow")
        require("av")

        rate = int(fps) if float(fps).is_integer() else fps
        self.info: dict[str, Any] = {
            "codebase_version": VERSION,
            "robot_type": None,
            "total_episodes": 0,
            "total_frames": 0,
            "total_tasks": 0,
            "chunks_size": FILES_IN_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": rate,
            "splits": {},
            "data_path": DATA,
            "video_path": VIDEO,
            "features": {},
        }
        self._stats: dict[str, Stats] = {}
        self.tasks: list[str] = []

        if (root / "meta/info.json").exists():
            self._open(rate)
        elif not (root / UNFINISHED_FOLDER).is_dir() and root.is_dir() and any(root.iterdir()):
            # The folder of running episodes, which is the first file of a dataset, shows that the
            # first episode was not saved.
            raise ConfigError(
                f"{root}: not a LeRobotDataset, and not empty; record into a new folder"
            )

        # Remove the files of a running or uncounted episode after a crash.
        shutil.rmtree(root / UNFINISHED_FOLDER, ignore_errors=True)
        self._remove_uncounted()

    @property
    def episodes(self) -> int:
        """The number of complete episodes."""
        return int(self.info["total_episodes"])

    def begin(self, instruction: str, meaning: ActionSpec | None = None) -> RunningEpisode:
        """Begin an episode, to which frames are added.

        It is later passed to `save`, or abandoned. Several episodes may run at the same time.
        `meaning` describes the numbers of the actions, if their meaning is known.
        """
        unfinished = self.root / UNFINISHED_FOLDER
        unfinished.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=unfinished))
        meaning = meaning or ActionSpec()
        return RunningEpisode(
            folder,
            instruction,
            self.info["fps"],
            self.info["features"],
            self.interventions,
            self._lossless,
            meaning,
        )

    def save(self, episode: FinishedEpisode) -> None:
        """Move the files of an episode into the dataset, and write its rows and metadata.

        Raises:
            OSError: The disk is full, or cannot be written to; the dataset remains without the
                episode.
        """
        try:
            info, stats = self._write(episode)
            unfinished_info = self._unfinished_json(info, "meta/info.json")
        except BaseException:
            with suppress(OSError):
                self._remove_uncounted()  # other episodes need the space
            raise

        self._move(unfinished_info, self.root / "meta/info.json")  # now the episode counts
        self.info, self._stats = info, stats
        if episode.folder is not None:
            shutil.rmtree(episode.folder, ignore_errors=True)
        with suppress(OSError):  # another episode is running
            (self.root / UNFINISHED_FOLDER).rmdir()

    def _write(self, episode: FinishedEpisode) -> tuple[dict[str, Any], dict[str, Stats]]:
        """Move the files of an episode into the dataset, and write its rows; return the info and
        the statistics of the dataset with this episode.
        """
        number = self.episodes
        frames = len(episode.rows[ACTION])
        file_numbers = _file_numbers(number)
        first = int(self.info["total_frames"])
        tasks = list(dict.fromkeys(episode.instructions))
        self.tasks += [task for task in tasks if task not in self.tasks]

        index = np.arange(frames)
        rows = episode.rows | {
            "timestamp": (index / self.info["fps"]).astype(np.float32),
            "frame_index": index,
            "episode_index": np.full(frames, number),
            "index": first + index,
            "task_index": np.array([self.tasks.index(task) for task in episode.instructions]),
        }
        numbers = {key: values for key, values in rows.items() if values.dtype != object}
        stats = {key: of_values(values.reshape(frames, -1)) for key, values in numbers.items()}
        stats |= episode.images

        about: dict[str, Any] = {
            "episode_index": number,
            "tasks": tasks,
            "length": frames,
        }
        if self.interventions:
            about["label"] = episode.label or "none"
        about |= {f"data/{name}": value for name, value in file_numbers.items()}
        about |= {"dataset_from_index": first, "dataset_to_index": first + frames}
        for key in episode.videos:
            about |= {f"videos/{key}/{name}": value for name, value in file_numbers.items()}
            about |= {
                f"videos/{key}/from_timestamp": 0.0,
                f"videos/{key}/to_timestamp": frames / self.info["fps"],
            }
        about |= {f"meta/episodes/{name}": value for name, value in file_numbers.items()}
        for key, statistics in stats.items():
            about |= {f"stats/{key}/{name}": v.tolist() for name, v in statistics.items()}

        for key, path in episode.videos.items():
            self._move(path, self.root / VIDEO.format(video_key=key, **file_numbers))
        self._parquet(self._table(rows, episode.features), DATA.format(**file_numbers))
        self._parquet(self._tasks_table(), "meta/tasks.parquet")
        self._parquet(self._pa.Table.from_pylist([about]), EPISODES.format(**file_numbers))

        stats = joined(self._stats, stats)
        info = self.info | {
            "total_episodes": number + 1,
            "total_frames": first + frames,
            "total_tasks": len(self.tasks),
            "features": episode.features,
            "splits": {"train": f"0:{number + 1}"},
            INFO: episode.about.to_json(),
        }
        plain = {}
        for key, statistics in stats.items():
            plain[key] = {name: values.tolist() for name, values in statistics.items()}
        all_stats = plain | episode.about.to_statistics(first + frames)
        name = "meta/stats.json"
        self._move(self._unfinished_json(all_stats, name), self.root / name)
        return info, stats

    def _remove_uncounted(self) -> None:
        """Remove the files of an episode that was not saved completely."""
        uncounted = FILE.format(**_file_numbers(self.episodes))
        for folder in ("data", "videos/*", "meta/episodes"):
            for path in self.root.glob(f"{folder}/{uncounted}.*"):
                path.unlink()
        for path in (self.root / UNFINISHED_FOLDER).glob("*"):
            if path.is_file():  # the folders belong to running episodes
                path.unlink()

    def _open(self, fps: float) -> None:
        """Read the metadata of an existing dataset; raise `ConfigError` if it cannot be
        continued.
        """
        info = json.loads((self.root / "meta/info.json").read_text())
        for key, expected in (
            ("codebase_version", VERSION),
            ("fps", fps),
            ("data_path", DATA),
            ("video_path", VIDEO),
        ):
            if info.get(key) != expected:
                raise ConfigError(
                    f"{self.root}: expected {key} {expected!r}, got {info.get(key)!r}; record "
                    "into a new folder"
                )

        has_interventions = INTERVENTION_COLUMN in info["features"]
        if self.interventions and not has_interventions:
            raise ConfigError(
                f"{self.root}: expected a recording with interventions, got one whose frames lack "
                f"the column {INTERVENTION_COLUMN!r}; record into a new folder"
            )
        self.info = info
        self.interventions = has_interventions

        stats = json.loads((self.root / "meta/stats.json").read_text())
        stats.pop(STATISTICS, None)
        self._stats = {}
        for key, statistics in stats.items():
            self._stats[key] = {name: np.array(value) for name, value in statistics.items()}
        table = self._pq.read_table(self.root / "meta/tasks.parquet")
        self.tasks = table.column("__index_level_0__").to_pylist()[: info["total_tasks"]]

        # After a crash, the statistics may include an uncounted episode: compute them again.
        if int(self._stats[ACTION]["count"][0]) != info["total_frames"]:
            self._stats = {}
            for number in range(self.episodes):
                self._stats = joined(self._stats, self._stats_of_episode(number))

    def _stats_of_episode(self, number: int) -> dict[str, Stats]:
        """Read the statistics of an episode, by feature."""
        table = self._pq.read_table(self.root / EPISODES.format(**_file_numbers(number)))
        [about] = table.to_pylist()
        stats: dict[str, Stats] = {}
        for column, value in about.items():
            if column.startswith("stats/"):
                key, _, name = column.removeprefix("stats/").rpartition("/")
                stats.setdefault(key, {})[name] = np.array(value)
        return stats

    def _table(self, rows: Mapping[str, np.ndarray], features: Mapping[str, Any]) -> Any:
        pa = self._pa
        columns = {}
        for key, values in rows.items():
            # LeRobot reads a single number as a scalar, not as a list.
            if features[key]["shape"] == [1]:
                columns[key] = pa.array(
                    values.reshape(-1), pa.type_for_alias(features[key]["dtype"])
                )
            else:
                flat = pa.array(np.ascontiguousarray(values, np.float32).ravel())
                columns[key] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        return pa.table(columns)

    def _tasks_table(self) -> Any:
        """Make the table of tasks as LeRobot reads it: a pandas frame indexed by task."""
        pa, name = self._pa, "__index_level_0__"
        text: dict[str, Any] = {"pandas_type": "unicode", "numpy_type": "object"}
        columns: list[dict[str, Any]] = [
            {
                "name": "task_index",
                "field_name": "task_index",
                "pandas_type": "int64",
                "numpy_type": "int64",
            },
            {"name": None, "field_name": name, **text},
        ]
        pandas = {
            "index_columns": [name],
            "column_indexes": [
                {"name": None, "field_name": None, **text, "metadata": {"encoding": "UTF-8"}}
            ],
            "columns": [{**column, "metadata": None} for column in columns],
            "creator": {"library": "pyarrow", "version": pa.__version__},
            "pandas_version": "2.2.0",
        }
        table = pa.table(
            {"task_index": pa.array(range(len(self.tasks)), pa.int64()), name: pa.array(self.tasks)}
        )
        return table.replace_schema_metadata({"pandas": json.dumps(pandas)})

    def _parquet(self, table: Any, name: str) -> None:
        """Write a Parquet file of the dataset."""
        unfinished = self._unfinished_file(name)
        self._pq.write_table(table, unfinished, compression="snappy")
        self._move(unfinished, self.root / name)

    def _unfinished_json(self, value: object, name: str) -> Path:
        """Write a JSON file of the dataset, and return its path before it is complete."""
        unfinished = self._unfinished_file(name)
        unfinished.write_text(json.dumps(value, indent=4, ensure_ascii=False))
        return unfinished

    def _unfinished_file(self, name: str) -> Path:
        """Return the path at which a file is written before it is complete."""
        folder = self.root / UNFINISHED_FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        return folder / name.replace("/", "_")

    def _move(self, complete: Path, path: Path) -> None:
        """Rename a complete file.

        With `durable`, the file is on the disk under its new name when this function returns.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        if self._durable:
            _sync(complete)
        os.replace(complete, path)
        if self._durable:
            _sync(path.parent)


def _file_numbers(episode: int) -> dict[str, int]:
    """Return the numbers in the names of an episode's files."""
    return {"chunk_index": episode // FILES_IN_CHUNK, "file_index": episode % FILES_IN_CHUNK}


def _sync(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk."""
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)
