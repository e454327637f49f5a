"""Files that somebody else wrote: datasets, results and bundles from another machine or the
network. Their authors may have chosen every path and every length in them.
"""

from __future__ import annotations

import re
import string
from pathlib import Path, PurePosixPath

from vlagents_ray.errors import ConfigError

# A description of a dataset of 100,000 episodes in lines of JSON has 30 MB.
MOST_TEXT_BYTES = 256 * 2**20
_HUB_SNAPSHOTS, _HUB_BLOBS = "snapshots", "blobs"


def require_below(path: str, folder: str) -> str:
    """Return a relative path that a file contains.

    Args:
        path: The path.
        folder: What the path is relative to, for the error, such as "the folder of results".

    Raises:
        ConfigError: The path leads out of the folder.
    """
    components = PurePosixPath(path).parts
    if not components or path.startswith("/") or ".." in components or "\0" in path:
        raise ConfigError(
            f"expected a file in {folder}, got the path {path!r}, which leads out of it; do not "
            "trust the author of these files"
        )
    return path


def inside(home: Path, path: str, folder: str) -> Path:
    """Return the absolute path of a file in a folder, with links resolved; the file need not exist.

    A link from a snapshot in the cache of the Hugging Face hub to that cache's blobs is followed.

    Args:
        home: The folder.
        path: A relative path that one of its files contains.
        folder: What the folder is, for the error, such as "the folder of results".

    Raises:
        ConfigError: The path leads out of the folder, directly or through a symbolic link.
    """
    file = home / require_below(path, folder)
    real_path, real_home = file.resolve(), home.resolve()
    allowed = [real_home]
    if real_home.parent.name == _HUB_SNAPSHOTS:
        allowed.append(real_home.parent.parent / _HUB_BLOBS)
    if not any(real_path.is_relative_to(folder) for folder in allowed):
        raise ConfigError(
            f"{file}: expected a file in {folder}, got a symbolic link that leads out of it; if "
            "you trust it, replace it with a copy of its target"
        )
    return real_path


def existing_file(home: Path, path: str, folder: str) -> Path:
    """Return the path of a regular file in a folder, see `inside`; a pipe or a device would block
    its reader.

    Raises:
        ConfigError: The path leads out of the folder, or there is no regular file.
    """
    file = inside(home, path, folder)
    if not file.is_file():
        raise ConfigError(f"{file}: expected a file of {folder}, got none; is it complete?")
    return file


def read_text(file: Path) -> str:
    """Return the text of a small file.

    Raises:
        ConfigError: There is no regular file, it is larger than `MOST_TEXT_BYTES`, or it is not
            UTF-8.
    """
    if not file.is_file():
        raise ConfigError(f"{file}: expected a file, got none; is the folder complete?")
    size = file.stat().st_size
    if size > MOST_TEXT_BYTES:
        raise ConfigError(
            f"{file}: expected at most {MOST_TEXT_BYTES} bytes of text, got {size}; do not trust "
            "its author"
        )
    try:
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: expected text in UTF-8, got other bytes ({error})") from error


def fill_template(template: object, values: dict[str, str | int], where: str) -> str:
    """Return the path that a template describes.

    Only plain fields are replaced, with a width of at most nine digits: Python's own `format` would
    also read attributes, and pad to any width.

    Args:
        template: Such as "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet".
        values: The value of each field.
        where: The file and the key with the template, for the error.

    Raises:
        ConfigError: The template has another field, or another format of a field.
    """
    try:
        parts = list(string.Formatter().parse(str(template)))
    except ValueError as error:
        raise ConfigError(f"{where}: expected a path with fields, got {template!r}") from error

    path = ""
    for text, name, spec, conversion in parts:
        path += text
        if name is None:
            continue
        if name not in values or conversion or not _is_digits(spec or ""):
            raise ConfigError(
                f"{where}: expected only the fields {sorted(values)}, such as "
                f"{{{min(values)}:03d}}, got {str(template)[:200]!r}"
            )
        path += format(values[name], spec or "")
    return path


def _is_digits(spec: str) -> bool:
    """Return whether a field's format is none, or a number of digits from 1 to 9."""
    return re.fullmatch(r"(0?[1-9]d)?", spec) is not None
