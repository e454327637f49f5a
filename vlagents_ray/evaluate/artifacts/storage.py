"""The files of an episode: paths, atomic writing, and errors of the disk."""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from glob import escape
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from vlagents_ray import disk, foreign_files
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.ray_tools.git_state import GitState, code_in, code_of
from vlagents_ray.registry import target_of

VIDEOS, TRAJECTORIES, PROVENANCE = "videos", "trajectories", "provenance"
_FOLDER = "the folder of results"
_RESUME = "finished episodes are kept: continue with --resume"


def require_below(path: str) -> str:
    """Return the `path` of an episode's file in a results.db, which may come from another machine;
    raise `ConfigError` if it leads out of the folder of results.
    """
    return foreign_files.require_below(path, _FOLDER)


def inside(home: Path, path: str) -> Path:
    """Return the absolute path of the file `path` in the folder of results `home`; the file need
    not exist. Raise `ConfigError` if the path leads out of the folder.
    """
    return foreign_files.inside(home, path, _FOLDER)


def trajectory_videos(home: Path, trajectory: str) -> list[str]:
    """Return the paths of the MP4 files with a trajectory's images, relative to the folder of
    results `home`.
    """
    npz_file = home / require_below(trajectory)
    videos = sorted(npz_file.parent.glob(f"{escape(npz_file.stem)}_*.mp4"))
    return [str(video.relative_to(home)) for video in videos]


def require_there(path: Path) -> Path:
    """Check that an episode's file exists, and return its `path`.

    Raises:
        ConfigError: The file is missing, for example in a partial copy.
    """
    if not path.is_file():
        raise ConfigError(
            f"{path}: expected the file that results.db names, got none; copy the folder again "
            f"from its original place, with its {VIDEOS}/ and {TRAJECTORIES}/"
        )
    return path


def outcome(result: EpisodeResult) -> str:
    """Return the outcome of an episode: "success", "failure", "policy_error" or "infra_failed"."""
    if result.status != "done":
        return result.status
    return "success" if result.success_once else "failure"


def require_folder_of(file: Path) -> None:
    """Raise `ConfigError` if this file cannot be written because it is a folder, or because its
    folder does not exist.
    """
    if file.is_dir():
        raise ConfigError(f"{file}: expected a file, got a folder; add the name of a file")
    if not file.absolute().parent.is_dir():
        raise ConfigError(
            f"{file}: expected a file in an existing folder, got the missing folder {file.parent}; "
            f"create it first"
        )


def require_folder(folder: Path) -> None:
    """Raise `ConfigError` if this path is a file or is below a file, so that the folder cannot be
    created.
    """
    blocking = next((path for path in (folder, *folder.parents) if path.exists()), None)
    if blocking is not None and not blocking.is_dir():
        raise ConfigError(f"{folder}: expected a folder, got the file {blocking}; choose another")


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Return a context manager that yields a temporary path for writing, and renames the file to
    `path` when it is complete. Missing folders are created.

    If writing fails, the unfinished file is removed, since other files need the space on a full
    disk.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished_path = path.with_name(path.name + ".part")
    unfinished_path.unlink(missing_ok=True)
    try:
        yield unfinished_path
        os.replace(unfinished_path, path)
    except BaseException:
        unfinished_path.unlink(missing_ok=True)
        raise


def link_or_copy(source: Path, target: Path) -> None:
    """Make `target` a hard link to `source`, or a copy where the file system has no hard links."""
    with whole(target) as unfinished_path:
        try:
            os.link(source, unfinished_path)
        except OSError:  # `target` is on another file system, or the file system has no hard links
            shutil.copyfile(source, unfinished_path)


def storing(folder: Path) -> AbstractContextManager[None]:
    """Return a context manager that replaces disk errors in a folder of results with
    `StorageFailed`; see `vlagents_ray.disk.storing`.
    """
    return disk.storing(folder, _RESUME)


def driver_code() -> dict[str, GitState | None]:
    """Return the git state of the working directory and of this package; None where there is no
    git repository.
    """
    return {"folder": code_in(Path.cwd()), "vlagents_ray": code_of("vlagents_ray")}


def versions() -> dict[str, Any]:
    """Return the versions of Python, of packages and of the platform in the driver, and
    `driver_code` as JSON.
    """
    packages = {}
    for name in ("vlagents-ray", "ray", "numpy", "av"):
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = "not installed"

    code = {}
    for name, git_state in driver_code().items():
        code[name] = None if git_state is None else git_state.to_json()

    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        **packages,
        "code": code,
    }


def policy_code(metadata: dict[str, Any]) -> GitState | None:
    """Return the git state of a policy's code, with its diff; None if this process does not have
    the server's version of the code.
    """
    policy = metadata.get("policy")
    if not isinstance(policy, str):
        return None
    local_code = code_of(target_of("policies", policy))
    if local_code is None or local_code.to_json() != metadata.get("code"):
        return None
    return local_code


def save_diffs(out: Path, git_states: Iterable[GitState | None]) -> None:
    """Write the uncommitted changes of each git state to `out/provenance/SHA256.diff`, unless the
    file exists.
    """
    for code in git_states:
        if code is None or code.diff_sha256 is None:
            continue
        path = out / PROVENANCE / f"{code.diff_sha256}.diff"
        if not path.exists():
            with whole(path) as unfinished_path:
                unfinished_path.write_bytes(code.diff)
