"""A search for places where other processes can read a secret."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path


def leaked(secret: str, folders: Iterable[Path]) -> list[str]:
    """The files below `folders` that hold it, and processes but this one, by their command lines and environments."""
    sought = secret.encode()
    files = [file for folder in folders for file in folder.rglob("*") if file.is_file()]
    for process in Path("/proc").glob("[0-9]*"):
        files += [process / "cmdline", *([process / "environ"] if int(process.name) != os.getpid() else [])]
    found = []
    for file in files:
        try:
            if sought in file.read_bytes():
                found.append(str(file))
        except OSError:  # it has ended, or is another user's
            continue
    return found
