"""Checks of a checkpoint's files, without loading a model.

`unfinished` checks whether the files are complete; in doubt, it reports nothing. `weights_of`
identifies the weights with a digest, which takes seconds, and with the commit on the hub.
"""

from __future__ import annotations

import contextlib
import fnmatch
import hashlib
import itertools
import json
import logging
import os
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from vlagents_ray.abilities import HasWeightsId, ability
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Agent
from vlagents_ray.success import SUCCESS_FILE, read_curves

logger = logging.getLogger(__name__)

# Names that training programs use for unfinished files: the folders of orbax, and the usual
# suffixes.
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

# Suffixes of files that contain no weights. Such files are often written before the weights.
_TEXT = (".json", ".yaml", ".yml", ".txt", ".md", ".jinja")

METHOD = "sampled-sha256"
_WHOLE = 2**20  # bytes; a file up to this size is read in full
_BLOCK, _BLOCKS = 4096, 256  # bytes of a sampled block, and the number of blocks
_LONGEST_HEADER = 10**8  # largest header that safetensors permits, bytes
_COMMIT = re.compile(r"[0-9a-f]{40}")
# Files of a checkpoint that do not affect its behaviour: the suffixes of documentation, and the
# names of measurements, which may be written after the digest was recorded.
_BESIDE, _MEASURED = (".md", ".gitattributes", ".log"), (SUCCESS_FILE,)


def unfinished(path: Path) -> str | None:
    """Return why a checkpoint is incomplete.

    A .safetensors file must have the length that its header specifies. All files that an index
    names must exist. JSON must be valid. A zip file, as written by torch.save, must end with its
    directory. A folder must contain weights. Other kinds of files are not checked: the caller must
    also check that they no longer grow.

    Args:
        path: A file or a folder.

    Returns:
        The reason; None if nothing shows that the checkpoint is incomplete.
    """
    try:
        entries = [path, *sorted(path.rglob("*"))] if path.is_dir() else [path]
        files = [entry for entry in entries if entry.is_file()]
        if not files:
            return f"{path.name}: expected a file, got none"
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
    """Return why a file is incomplete, according to the check for its suffix; None if the file
    passes.
    """
    check = next((check for suffix, check in _CHECKS.items() if file.name.endswith(suffix)), None)
    try:
        return None if check is None else check(file)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        # The file is truncated, or not in the format of its name.
        return f"cannot be read ({error})"


def _safetensors(file: Path) -> str | None:
    """Return why a .safetensors file is incomplete; None if it has the length that its header
    specifies.
    """
    size = file.stat().st_size
    with file.open("rb") as opened:
        length = int.from_bytes(opened.read(8), "little")
        if size < 8 + length:
            return f"expected at least {8 + length} bytes, those of its header, got {size}"
        ends = [end for _, end in _data_offsets(opened.read(length))]
    expected_size = 8 + length + max(ends, default=0)
    return None if size == expected_size else f"has {size} bytes, its header says {expected_size}"


def _data_offsets(header: bytes) -> list[tuple[int, int]]:
    """Return the start and the end of each tensor's bytes in a .safetensors file, relative to the
    end of the JSON header.

    The first 8 bytes of the file are the length of the header.
    """
    entries = json.loads(header)
    entries.pop("__metadata__", None)
    return [tuple(entry["data_offsets"]) for entry in entries.values()]


def _index(file: Path) -> str | None:
    """Return which files of an index do not exist, as a message; None if all exist."""
    names = set(json.loads(file.read_text(encoding="utf-8"))["weight_map"].values())
    absent = sorted(name for name in names if not (file.parent / name).is_file())
    return f"names {absent}, which are missing" if absent else None


def _json(file: Path) -> str | None:
    """Return None if the file is valid JSON; otherwise raise `ValueError`."""
    json.loads(file.read_text(encoding="utf-8"))
    return None


def _zip(file: Path) -> str | None:
    """Return why a file of torch.save is incomplete; None if nothing shows that it is."""
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


def identify_weights(agent: Agent, paths: Sequence[Path]) -> dict[str, Any] | None:
    """Return the identity of the weights that a policy has loaded, for the metadata.

    Args:
        agent: The policy, after `initialize`.
        paths: The files and folders that the policy found while it was initialized.

    Returns:
        The `HasWeightsId.weights_id` of the policy if it has one, otherwise the identity of the
        files; None if there are no files.
    """
    has_id = ability(agent, HasWeightsId)
    return (has_id.weights_id if has_id is not None else None) or weights_of(paths)


def success_of(paths: Sequence[Path], digest: str | None) -> list[dict[str, Any]]:
    """Return the measured success of a policy's checkpoint as JSON, for the metadata.

    Curves of other weights are left out, such as curves of the base of an adapter. A file that
    cannot be read is logged and left out: the policy does not depend on it.

    Args:
        paths: The files and folders that the policy found; the first one is its checkpoint.
        digest: The digest of the loaded weights.
    """
    if not paths:
        return []
    try:
        curves = read_curves(paths[0] if paths[0].is_dir() else paths[0].parent)
    except ConfigError as error:
        logger.warning("%s", error)
        return []
    return [curve.to_json() for curve in curves if curve.weights in (None, digest)]


def weights_of(paths: Sequence[Path]) -> dict[str, str | None] | None:
    """Return the identity of a policy's files, as `HasWeightsId` describes it.

    The digest covers all files. The revision is the commit of the first path, since other paths,
    such as the path of an encoder, may come from another repository.

    Args:
        paths: Files and folders; the first one is the policy's checkpoint.

    Returns:
        The digest and the revision; None if there are no paths.
    """
    if not paths:
        return None
    return {"digest": digest(paths), "revision": revision(paths[0])}


def digest(paths: Iterable[Path]) -> str:
    """Return a digest of files, `sampled-sha256:` and 64 hexadecimal digits.

    Equal files with equal names have equal digests. The digest covers the name and the size of each
    file, and some of its content. The files of a folder are sorted by name.

    - A file of at most 1 MiB is read in full.
    - From a larger .safetensors file, the header and 4 KiB in the middle of each tensor are read.
    - From a zip file, as written by torch.save, the directory is read, which contains the CRC-32 of
      each entry.
    - From any other file, 256 blocks of 4 KiB at equal distances are read.

    Therefore, different weights, statistics or settings have different digests, but a deliberate
    change of a few bytes may not be noticed. Hidden files, READMEs and curves of success are not
    covered.
    """
    sha256 = hashlib.sha256()
    for path in paths:
        for file in files_in(path):
            name = file.name if file == path else file.relative_to(path).as_posix()
            # A file that cannot be read or no longer exists was not loaded.
            with contextlib.suppress(OSError):
                size = file.stat().st_size
                sha256.update(json.dumps([name, size]).encode())
                with file.open("rb") as opened:
                    for block in _sampled_blocks(file, opened, size):
                        sha256.update(block)
    return f"{METHOD}:{sha256.hexdigest()}"


def revision(path: Path) -> str | None:
    """Return the commit of a path in a snapshot of the hub's cache; None for any other path."""
    for folder, name in itertools.pairwise(path.absolute().parts):
        if folder == "snapshots" and _COMMIT.fullmatch(name):
            return name
    return None


def files_in(path: Path) -> list[Path]:
    """Return the files of a checkpoint that its digest covers, sorted by name."""
    if path.is_file():
        return [path]
    return sorted(_below(path, set()))


def _below(folder: Path, seen: set[str]) -> Iterator[Path]:
    """Yield the files of a folder that a digest covers.

    Links are followed, as loaders do.

    Args:
        folder: The folder.
        seen: The real paths of the folders that have been entered, which are not entered again:
            each of them could be linked any number of times. This folder is added.
    """
    seen.add(os.path.realpath(folder))
    with contextlib.suppress(OSError):  # The folder cannot be read or no longer exists.
        # Sorted, so that the first of several links to a folder is always the same one.
        for entry in sorted(folder.iterdir()):
            if entry.name.startswith((".", "__pycache__")):
                continue
            if entry.is_file():
                if entry.suffix not in _BESIDE and entry.name not in _MEASURED:
                    yield entry
            elif entry.is_dir() and os.path.realpath(entry) not in seen:
                yield from _below(entry, seen)


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
    """Read the header of a .safetensors file.

    Returns:
        The header, and the start and the length of a block in the middle of each tensor; None if
        the file has another format.
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
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return text, blocks
