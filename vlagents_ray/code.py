"""Which code runs: the commit of a git repository, and in what its files differ from that."""

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

MOST_BYTES = 1_000_000  # of a diff that is kept
_TIMEOUT_S = 30.0


@dataclass(frozen=True, slots=True)
class Code:
    """The state of a repository's tracked files; what git does not track is nowhere in it."""

    commit: str  # 40 hexadecimal digits
    diff_sha256: str | None  # of the whole difference from the commit; None if there is none
    diff: bytes  # as `git diff` writes it; of a long one the first `MOST_BYTES`

    def to_json(self) -> dict[str, Any]:
        """What identifies it, without the difference itself."""
        return {"commit": self.commit, "dirty": self.diff_sha256 is not None, "diff_sha256": self.diff_sha256}


def code_in(folder: Path) -> Code | None:
    """That of the repository in which `folder` lies; None if it lies in none, or git is not there."""
    top = _git(folder, "rev-parse", "--show-toplevel")
    return None if top is None else _code(top.decode().rstrip("\n"))


def code_of(target: str) -> Code | None:
    """That of "module" or "module:Class", which is found and not imported; None unless git tracks its file."""
    try:
        spec = importlib.util.find_spec(target.partition(":")[0])
    except (ImportError, ValueError):  # a package above it that is not there; a module without a spec
        return None
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        return None
    file = Path(spec.origin)
    # An installed package may lie inside a repository, in an environment that this does not track.
    if _git(file.parent, "ls-files", "--error-unmatch", "--", file.name) is None:
        return None
    return code_in(file.parent)


@functools.cache
def _code(top: str) -> Code | None:
    """As the process found it: what is edited later is not what runs."""
    commit = _git(Path(top), "rev-parse", "--verify", "HEAD")
    diff = _git(Path(top), "diff", "--no-ext-diff", "--no-textconv", "--no-color", "HEAD")
    if commit is None or diff is None:
        return None
    sha256 = hashlib.sha256(diff).hexdigest() if diff else None
    return Code(commit.decode().strip(), sha256, diff[:MOST_BYTES])


def _git(folder: Path, *words: str) -> bytes | None:
    """What git says; None if it fails."""
    git = shutil.which("git")
    if git is None:
        return None
    quiet = os.environ | {"GIT_OPTIONAL_LOCKS": "0"}
    try:
        asked = subprocess.run(  # noqa: S603 - words of ours, and a folder
            [git, "-C", str(folder), *words], capture_output=True, timeout=_TIMEOUT_S, env=quiet, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return asked.stdout if asked.returncode == 0 else None
