"""Is a checkpoint on disk written to its end? Judged from the files alone, and in doubt: no."""

from __future__ import annotations

import fnmatch
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

# What trainers call a thing that they have not written to its end: orbax' folders, and the usual suffixes.
TEMPORARY = ("*.orbax-checkpoint-tmp*", "*.tmp", "*.tmp-*", "*.part", "*.partial", "*.incomplete", "tmp-*", ".tmp*")

_TEXT = (".json", ".yaml", ".yml", ".txt", ".md", ".jinja")  # what is written beside weights, and often before them


def is_temporary(name: str) -> bool:
    """Does this name of a file or folder say that it will be renamed when it is whole?"""
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in TEMPORARY)


def unfinished(path: Path) -> str | None:
    """What shows that the checkpoint, a file or a folder, is not whole; None if nothing does.

    A .safetensors file is as long as its header says, an index names only files that are there, JSON can be parsed,
    and a zip file, as torch.save writes, has its directory at the end. A file of another kind shows nothing: that it
    no longer grows has to be looked at besides. A folder without weights is not whole.
    """
    try:
        entries = [path, *sorted(path.rglob("*"))] if path.is_dir() else [path]
        files = [entry for entry in entries if entry.is_file()]
        if not files:
            return f"{path.name}: no file is there"
        if all(file.suffix in _TEXT for file in files):
            return f"{path.name}: holds no weights, only {[file.name for file in files]}"
        for entry in entries:
            if is_temporary(entry.name):
                return f"{entry.name}: its name is a temporary one"
        for file in files:
            trouble = _trouble(file)
            if trouble is not None:
                return f"{file.name}: {trouble}"
    except FileNotFoundError as error:
        return f"{error.filename}: went away while it was looked at"
    return None


def _trouble(file: Path) -> str | None:
    check = next((check for suffix, check in _CHECKS.items() if file.name.endswith(suffix)), None)
    try:
        return None if check is None else check(file)
    except (ValueError, KeyError, TypeError, AttributeError) as error:  # cut short, or not what its name says
        return f"cannot be read ({error})"


def _safetensors(file: Path) -> str | None:
    """The format: 8 bytes with the header's length, the header (JSON), and the data that it describes."""
    size = file.stat().st_size
    with file.open("rb") as opened:
        length = int.from_bytes(opened.read(8), "little")
        if size < 8 + length:
            return f"has {size} bytes, its header alone has {8 + length}"
        header = json.loads(opened.read(length))
    ends = [tensor["data_offsets"][1] for name, tensor in header.items() if name != "__metadata__"]
    wanted = 8 + length + max(ends, default=0)
    return None if size == wanted else f"has {size} bytes, its header says {wanted}"


def _index(file: Path) -> str | None:
    names = set(json.loads(file.read_text(encoding="utf-8"))["weight_map"].values())
    absent = sorted(name for name in names if not (file.parent / name).is_file())
    return f"names {absent}, which are missing" if absent else None


def _json(file: Path) -> str | None:
    json.loads(file.read_text(encoding="utf-8"))
    return None


def _zip(file: Path) -> str | None:
    with file.open("rb") as opened:
        begins = opened.read(4)
    if not begins:
        return "is empty"
    return "is a zip file without its end" if begins == b"PK\x03\x04" and not zipfile.is_zipfile(file) else None


_CHECKS: dict[str, Callable[[Path], str | None]] = {
    ".safetensors": _safetensors,
    ".index.json": _index,
    ".json": _json,
    ".pt": _zip,
    ".pth": _zip,
    ".bin": _zip,
    ".ckpt": _zip,
}
