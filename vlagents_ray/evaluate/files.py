"""Where an episode's own files lie in a folder of results, and how they get there whole."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vlagents_ray.evaluate.cells import Cell
from vlagents_ray.evaluate.episode import EpisodeResult
from vlagents_ray.evaluate.jobs import EpisodeKey

VIDEOS, TRAJECTORIES, PROVENANCE = "videos", "trajectories", "provenance"


def episode_folder(out: Path, kind: str, cell: Cell) -> Path:
    """`out/KIND/POLICY/SUITE/ENV`; a suite without a name has no folder."""
    return out.joinpath(kind, *(plain(part) for part in cell.name if part))


def stem(key: EpisodeKey) -> str:
    """What the names of an episode's files begin with; "_" or "." follows."""
    return f"ep{key.episode:04d}_seed{key.seed}"


def remove_old(folder: Path, key: EpisodeKey) -> None:
    """Remove what an earlier attempt at the episode left."""
    for old in folder.glob(f"{stem(key)}[_.]*"):
        old.unlink()


def outcome(result: EpisodeResult) -> str:
    """How an episode ended, in a word."""
    if result.status != "done":
        return result.status
    return "success" if result.success_once else "failure"


def plain(name: str) -> str:
    """`name` as a part of a file's name: "maniskill/PushCube-v1" -> "maniskill_PushCube-v1", "pi0@20" as it is."""
    return re.sub(r"[^\w.@-]+", "_", name)


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A name to write a file under, which becomes `path` when it is whole; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.unlink(missing_ok=True)
    yield part
    os.replace(part, path)


def link_or_copy(source: Path, target: Path) -> None:
    """The same file at another place: a second name where the file system allows it, else a copy."""
    with whole(target) as part:
        try:
            os.link(source, part)
        except OSError:  # another file system, or one without hard links
            shutil.copyfile(source, part)
