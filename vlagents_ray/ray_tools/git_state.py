"""The version of the running code: the commit of its git repository, and the difference from it."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MOST_BYTES = 1_000_000  # largest number of bytes of a diff that are stored
_TIMEOUT_S = 30.0


@dataclass(frozen=True, slots=True)
class GitState:
    """The state of the tracked files of a repository, or of one of its folders; untracked files
    are not part of it.
    """

    # 40 hexadecimal digits: the checked-out commit, or the last commit that changed the folder.
    commit: str
    # Hash of the complete difference from the commit; None if there is no difference.
    diff_sha256: str | None
    diff: bytes  # output of `git diff`, truncated to `MOST_BYTES`

    def to_json(self) -> dict[str, Any]:
        """Return the commit and the hash of the difference, without the difference itself."""
        return {
            "commit": self.commit,
            "dirty": self.diff_sha256 is not None,
            "diff_sha256": self.diff_sha256,
        }


@functools.cache
def code_in(folder: Path) -> GitState | None:
    """Return the state of the repository that contains a folder; None if there is none, or git
    is not installed.

    It is the state at the first call, since later edits do not change the running code.
    """
    top = _git(folder, "rev-parse", "--show-toplevel")
    return None if top is None else _code(top.decode().rstrip("\n"))


def code_of(target: str) -> GitState | None:
    """Return the state of the repository of "module" or "module:Class"; None if git does not track
    its file.

    A package without a class is its folder alone: an edit or a commit of other files in its
    repository, such as tests and pages, does not change it. The module is located, but not
    imported.
    """
    try:
        spec = importlib.util.find_spec(target.partition(":")[0])
    except (ImportError, ValueError):
        # A parent package is not installed, or the module has no spec.
        return None
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        return None
    file = Path(spec.origin)
    # An installed package may be in a virtual environment within a repository that does not track
    # it.
    if not _is_tracked(file):
        return None
    is_package = spec.submodule_search_locations is not None
    return _code(str(file.parent)) if is_package and ":" not in target else code_in(file.parent)


@functools.cache
def _is_tracked(file: Path) -> bool:
    """Return whether git tracks a file, at the first call."""
    return _git(file.parent, "ls-files", "--error-unmatch", "--", file.name) is not None


@functools.cache
def _code(folder: str) -> GitState | None:
    """Return the state of a folder in a repository, at the first call."""
    is_top = _git(Path(folder), "rev-parse", "--show-prefix") == b"\n"
    words = ("rev-parse", "--verify", "HEAD") if is_top else ("log", "-1", "--format=%H", "--", ".")
    commit = _git(Path(folder), *words)
    plain = ("--no-ext-diff", "--no-textconv", "--no-color")
    diff = _git(Path(folder), "diff", *plain, "HEAD", "--", ".")
    if not commit or diff is None:
        return None
    sha256 = hashlib.sha256(diff).hexdigest() if diff else None
    return GitState(commit.decode().strip(), sha256, diff[:MOST_BYTES])


def _git(folder: Path, *words: str) -> bytes | None:
    """Return the output of git; None if it fails."""
    git = shutil.which("git")
    if git is None:
        return None
    environment = os.environ | {"GIT_OPTIONAL_LOCKS": "0"}
    try:
        done = subprocess.run(  # noqa: S603 - the arguments are constants and a folder
            [git, "-C", str(folder), *words],
            capture_output=True,
            timeout=_TIMEOUT_S,
            env=environment,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None
