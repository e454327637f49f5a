"""Files that somebody else wrote: every path and length in them may be chosen to do harm."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from vlagents_ray.datasets.episode import ACTION, STATE
from vlagents_ray.errors import ConfigError
from vlagents_ray.foreign_files import fill_template, inside, read_text
from vlagents_ray.images.mp4 import Mp4, read_mp4
from vlagents_ray.recorded_dataset import Names, RecordedDataset

CAMERA = "observation.images.front"
LENGTH = 2
Change = Callable[[Path, dict[str, Any]], None]


def video(file: Path, height: int = 16, width: int = 16) -> None:
    mp4 = Mp4(file, (height, width, 3), 10)
    for _ in range(LENGTH):
        mp4.add(np.zeros((height, width, 3), np.uint8))
    mp4.finish()


def write_dataset(root: Path, change: Change) -> None:
    """Write a dataset of one episode, after `change` has changed its files and description."""
    for folder in ("meta/episodes/a", "data", "videos"):
        (root / folder).mkdir(parents=True)
    info: dict[str, Any] = {
        "codebase_version": "v3.0",
        "fps": 10,
        "data_path": "data/{file_index:03d}.parquet",
        "video_path": "videos/{video_key}-{file_index:03d}.mp4",
        "features": {
            ACTION: {"dtype": "float32", "shape": [2], "names": None},
            STATE: {"dtype": "float32", "shape": [2]},
            CAMERA: {"dtype": "video", "shape": [16, 16, 3]},
        },
    }
    episode = {"episode_index": [0], "length": [LENGTH], "tasks": [["x"]]}
    for content in ("data", f"videos/{CAMERA}"):
        episode |= {f"{content}/chunk_index": [0], f"{content}/file_index": [0]}
    pq.write_table(pa.table(episode), root / "meta/episodes/a/e.parquet")
    zeros = [[0.0, 0.0]] * LENGTH
    rows = {"episode_index": [0] * LENGTH, ACTION: zeros, STATE: zeros}
    pq.write_table(pa.table(rows), root / "data/000.parquet")
    video(root / f"videos/{CAMERA}-000.mp4")

    change(root, info)
    (root / "meta/info.json").write_text(json.dumps(info))


def frames(root: Path) -> int:
    """Return the number of frames of a dataset, all of which are read."""
    dataset = RecordedDataset(root)
    [session] = dataset.sessions()
    return len(list(dataset.steps(session.episodes[0], Names(), None)))


def unchanged(*_: object) -> None:
    """Leave the dataset as it is."""


def setting(key: str, value: str) -> Change:

    def change(_: Path, info: dict[str, Any]) -> None:
        info[key] = value

    return change


def replaced(name: str, make: Callable[[Path], object]) -> Change:
    """Return a change that replaces a file of the dataset by what `make` makes at its path."""

    def change(root: Path, info: dict[str, Any]) -> None:
        (root / name).unlink()
        make(root / name)

    return change


def many_rows(file: Path) -> None:
    nothing = pa.array([None] * 10**6, pa.list_(pa.float32()))
    index = pa.array(np.zeros(10**6, np.int64))
    pq.write_table(pa.table({"episode_index": index, ACTION: nothing, STATE: nothing}), file)


VIDEO, DATA = f"videos/{CAMERA}-000.mp4", "data/000.parquet"
PLAYLIST = "#EXTM3U\n#EXTINF:1,\nfile:///private/home.ts\n#EXT-X-ENDLIST\n"
HOSTILE: dict[str, Change] = {
    "a video above the folder": setting("video_path", "../private.mp4"),
    "an absolute video": setting("video_path", "/private.mp4"),
    "rows above the folder": setting("data_path", "data/../../private.parquet"),
    "a width of a number": setting("data_path", "data/{file_index:>3000000000}"),
    "attributes of a number": setting("data_path", "data/{file_index.__class__}"),
    "a conversion": setting("data_path", "data/{file_index!r}"),
    "an unknown field": setting("data_path", "data/{root}"),
    "half a field": setting("data_path", "data/{file_index"),
    "a link to a video": replaced(VIDEO, lambda file: file.symlink_to("/private.mp4")),
    "a link to rows": replaced(DATA, lambda file: file.symlink_to("/private.parquet")),
    "a pipe": replaced(VIDEO, os.mkfifo),
    "a playlist": replaced(VIDEO, lambda file: file.write_text(PLAYLIST)),
    "a list of files": replaced(VIDEO, lambda file: file.write_text("ffconcat version 1.0\n")),
    "a large video": replaced(VIDEO, lambda file: video(file, 4096, 4096)),
    "a million equal rows": replaced(DATA, many_rows),
}


def test_an_ordinary_dataset_is_read(tmp_path: Path) -> None:
    write_dataset(tmp_path / "set", unchanged)
    assert frames(tmp_path / "set") == LENGTH


@pytest.mark.parametrize("name", HOSTILE)
def test_a_dataset_reads_nothing_outside_and_nothing_larger_than_it_says(
    name: str, tmp_path: Path
) -> None:
    video(tmp_path / "private.mp4")
    write_dataset(tmp_path / "set", HOSTILE[name])
    with pytest.raises(ConfigError):
        frames(tmp_path / "set")


def test_files_in_the_cache_of_the_hub_are_links_to_its_blobs(tmp_path: Path) -> None:
    snapshot = tmp_path / "snapshots" / "0123"
    write_dataset(snapshot, unchanged)
    (tmp_path / "blobs").mkdir()
    (snapshot / VIDEO).rename(tmp_path / "blobs" / "4567")
    (snapshot / VIDEO).symlink_to("../../../blobs/4567")
    assert frames(snapshot) == LENGTH


@pytest.mark.parametrize("path", ["", "..", "a/../../b", "/a", "a\0b"])
def test_a_path_that_leads_out_of_the_folder_is_refused(path: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="which leads out of it"):
        inside(tmp_path, path, "the folder")


@pytest.mark.parametrize("spec", ["", ":d", ":3d", ":03d", ":06d"])
def test_a_template_is_filled_as_python_does(spec: str) -> None:
    template = f"a-{{index{spec}}}/b" if spec != ":d" else "a-{index}/b"
    assert fill_template(template, {"index": 7}, "info") == template.format(index=7)


def test_a_text_is_a_file_in_utf_8(tmp_path: Path) -> None:
    (tmp_path / "text").write_bytes(b"\xff")
    for name in ("text", "absent", "."):
        with pytest.raises(ConfigError, match="expected"):
            read_text(tmp_path / name)


def test_what_is_no_mp4_is_refused_and_names_its_file(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_text("text")
    with (
        pytest.raises(ConfigError, match=r"a\.mp4: expected an MP4 file"),
        read_mp4(tmp_path / "a.mp4", 100),
    ):
        pass
