"""Checks of a checkpoint's files without a model: whether they are complete, and which weights they
hold.

`unfinished` examines only the files, and reports nothing in doubt. `weights_of` identifies weights
by a digest that takes seconds, and by the commit on the hub.
"""

from __future__ import annotations

import contextlib
import fnmatch
import hashlib
import itertools
import json
import os
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

# Names that trainers give to files in progress: orbax' folders, and the usual suffixes.
TEMPORARY = (
    "*.orbax-checkpoint-tmp*",
    "*.tmp",
    "*.tmp-*",
    "*.part",
    "*.partial",
    "*.incomplete",
    "tmp-*",
    ".tmp*",
)

# Written along with weights, and often before them.
_TEXT = (".json", ".yaml", ".yml", ".txt", ".md", ".jinja")

METHOD = "sampled-sha256"
_WHOLE = 2**20  # bytes; a file up to this size is read in full
_BLOCK, _BLOCKS = 4096, 256
_LONGEST_HEADER = 10**8  # bytes; the limit of safetensors
_COMMIT = re.compile(r"[0-9a-f]{40}")
# Files about a checkpoint, which do not affect its behaviour.
_BESIDE = (".md", ".gitattributes", ".log")


def unfinished(path: Path) -> str | None:
    """Return the sign that a checkpoint, a file or a folder, is incomplete; None if there is no
    sign.

    A .safetensors file must have the length in its header, an index may name only existing files,
    JSON must be valid, and a zip file, as written by torch.save, must end with its directory. Files
    of other kinds give no sign: the caller must also check that they no longer grow. A folder
    without weights is incomplete.
    """
    try:
        entries = [path, *sorted(path.rglob("*"))] if path.is_dir() else [path]
        files = [entry for entry in entries if entry.is_file()]
        if not files:
            return f"{path.name}: no file is there"
        if all(file.suffix in _TEXT for file in files):
            return f"{path.name}: holds no weights, only {[file.name for file in files]}"

        for entry in entries:
            if any(fnmatch.fnmatchcase(entry.name, pattern) for pattern in TEMPORARY):
                return f"{entry.name}: its name is a temporary one"
        for file in files:
            trouble = _trouble(file)
            if trouble is not None:
                return f"{file.name}: {trouble}"
    except FileNotFoundError as error:
        return f"{error.filename}: went away while it was looked at"
    return None


def _trouble(file: Path) -> str | None:
    """Return the sign that a file is incomplete, by the check for its suffix; None if there is
    none.
    """
    check = next((check for suffix, check in _CHECKS.items() if file.name.endswith(suffix)), None)
    try:
        return None if check is None else check(file)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        # The file is truncated, or not in the format of its name.
        return f"cannot be read ({error})"


def _safetensors(file: Path) -> str | None:
    size = file.stat().st_size
    with file.open("rb") as opened:
        length = int.from_bytes(opened.read(8), "little")
        if size < 8 + length:
            return f"has {size} bytes, its header alone has {8 + length}"
        ends = [end for _, end in _data_offsets(opened.read(length))]
    expected_size = 8 + length + max(ends, default=0)
    return None if size == expected_size else f"has {size} bytes, its header says {expected_size}"


def _data_offsets(header: bytes) -> list[tuple[int, int]]:
    """Return start and end of each tensor's bytes after the header (JSON) of a .safetensors file.

    The file begins with 8 bytes, the length of the header.
    """
    entries = json.loads(header)
    return [
        tuple(entry["data_offsets"]) for name, entry in entries.items() if name != "__metadata__"
    ]


def _index(file: Path) -> str | None:
    names = set(json.loads(file.read_text(encoding="utf-8"))["weight_map"].values())
    absent = sorted(name for name in names if not (file.parent / name).is_file())
    return f"names {absent}, which are missing" if absent else None


def _json(file: Path) -> str | None:
    json.loads(file.read_text(encoding="utf-8"))
    return None


def _zip(file: Path) -> str | None:
    with file.open("rb") as opened:
        first_bytes = opened.read(4)
    if not first_bytes:
        return "is empty"
    if first_bytes == b"PK\x03\x04" and not zipfile.is_zipfile(file):
        return "is a zip file without its end"
    return None


_CHECKS: dict[str, Callable[[Path], str | None]] = {
    ".safetensors": _safetensors,
    ".index.json": _index,
    ".json": _json,
    ".pt": _zip,
    ".pth": _zip,
    ".bin": _zip,
    ".ckpt": _zip,
}


def weights_of(paths: Sequence[Path]) -> dict[str, str | None] | None:
    """Return `Agent.weights_id` of files and folders, of which the first is the policy's own; None
    if there are none.

    The digest covers all of them, the revision only the first: later ones, such as an encoder's,
    may come from another repository.
    """
    return {"digest": digest(paths), "revision": revision(paths[0])} if paths else None


def digest(paths: Iterable[Path]) -> str:
    """Return `sampled-sha256:` and 64 hexadecimal digits, which are equal for equal files with
    equal names.

    The digest covers the name and the size of each file, in a folder sorted by name, and part of
    its content:

    - all of it up to 1 MiB;
    - of a larger .safetensors file the header and 4 KiB in the middle of each tensor;
    - of a zip file, as written by torch.save, the directory with the CRC-32 of each part;
    - of any other file 256 blocks of 4 KiB at equal distances.

    Different weights, statistics or settings therefore have different digests, but a deliberate
    change of a few bytes may go unnoticed. Hidden files and READMEs do not count.
    """
    sha256 = hashlib.sha256()
    for path in paths:
        for file in files_in(path):
            name = file.name if file == path else file.relative_to(path).as_posix()
            # A file that cannot be read, or is gone, was not loaded.
            with contextlib.suppress(OSError):
                size = file.stat().st_size
                sha256.update(json.dumps([name, size]).encode())
                with file.open("rb") as opened:
                    for block in _sampled_blocks(file, opened, size):
                        sha256.update(block)
    return f"{METHOD}:{sha256.hexdigest()}"


def revision(path: Path) -> str | None:
    """Return the commit of the hub's repository if `path` is in a snapshot of the hub's cache,
    else None.
    """
    parts = path.absolute().parts
    commits = [commit for folder, commit in itertools.pairwise(parts) if folder == "snapshots"]
    return next((commit for commit in commits if _COMMIT.fullmatch(commit)), None)


def files_in(path: Path) -> list[Path]:
    """Return the files of a checkpoint that count for its digest, in the order of their names."""
    if path.is_file():
        return [path]
    return sorted(_below(path, frozenset()))


def _below(folder: Path, above: frozenset[str]) -> Iterator[Path]:
    """Yield the files of a folder that count, following links as loaders do; `above` are the
    folder's parents.
    """
    within = above | {os.path.realpath(folder)}
    with contextlib.suppress(OSError):  # The folder cannot be read, or is gone.
        for entry in list(folder.iterdir()):
            if entry.name.startswith((".", "__pycache__")):
                continue
            if entry.is_file():
                if entry.suffix not in _BESIDE:
                    yield entry
            elif entry.is_dir() and os.path.realpath(entry) not in within:
                yield from _below(entry, within)


def _sampled_blocks(file: Path, opened: BinaryIO, size: int) -> Iterator[bytes]:
    """Yield the bytes of a file of `size` bytes that its digest covers; see `digest`."""
    if size <= _WHOLE:
        yield opened.read()
        return

    header = _header(opened) if file.suffix == ".safetensors" else None
    if header is not None:
        text, blocks = header
        yield text
        for start, length in blocks:
            opened.seek(start)
            yield opened.read(length)
    elif zipfile.is_zipfile(file):
        with contextlib.suppress(zipfile.BadZipFile), zipfile.ZipFile(file) as archive:
            directory = [[info.filename, info.file_size, info.CRC] for info in archive.infolist()]
            yield json.dumps(directory).encode()
    else:
        for i in range(_BLOCKS):
            opened.seek((size - _BLOCK) * i // (_BLOCKS - 1))
            yield opened.read(_BLOCK)


def _header(opened: BinaryIO) -> tuple[bytes, list[tuple[int, int]]] | None:
    """Return the header of a .safetensors file, and the start and length of a block in the middle
    of each tensor.

    Returns None if the file has another format.
    """
    length = int.from_bytes(opened.read(8), "little")
    if length > _LONGEST_HEADER:
        return None

    text = opened.read(length)
    blocks = []
    try:
        for begin, end in _data_offsets(text):
            middle = max(begin, (begin + end - _BLOCK) // 2)
            blocks.append((8 + length + middle, min(_BLOCK, end - begin)))
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
    return text, blocks
