"""An evaluation in one file, which other people can cite, reproduce, and merge with their own
results.

The file is a ZIP archive whose first member lists the other members with their digests. An archive
may come from a stranger. The list of members is checked before any member is read: each name is one
that `pack` could have written, so that none leads out of the folder; no member is a link; the sizes
are bounded, and no member yields more bytes than its declared size. Nothing is unpickled or
imported. `verification` executes the recorded actions.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sqlite3
import stat
import tempfile
import zipfile
import zlib
from contextlib import closing
from pathlib import Path
from typing import IO, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts import storage
from vlagents_ray.evaluate.plan.config import canonical
from vlagents_ray.evaluate.results.database import FILE as DATABASE
from vlagents_ray.evaluate.results.reader import Results, reading

MANIFEST = "bundle.json"
MOST_BYTES = 16 * 10**9  # maximum number of bytes of all members, unpacked
_MOST_MEMBERS = 200_000
_MOST_MANIFEST = 64 * 2**20  # maximum size of the manifest, bytes
_CHUNK = 2**20
_SHOWN = 3  # maximum number of files in a message
# A part of a path, as `naming.plain` creates names: it does not begin with a dot.
_PART = r"[\w@-][\w.@-]{0,200}"
_KNOWN = re.compile(
    rf"{re.escape(MANIFEST)}|{re.escape(DATABASE)}|{storage.PROVENANCE}/[0-9a-f]{{64}}\.diff"
    rf"|{storage.TRAJECTORIES}/({_PART}/){{1,3}}{_PART}\.(npz|mp4)|{storage.VIDEOS}/({_PART}/){{1,3}}{_PART}\.mp4"
)
_BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError)
_DISTRUST = "`vlagents-ray bundle` never writes this: do not trust the author of this bundle"


class FileDigest(BaseModel):
    """A file of a bundle."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    size: int = Field(ge=0)  # size, bytes


class Manifest(BaseModel):
    """The content of `bundle.json`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["vlagents-ray bundle"] = "vlagents-ray bundle"
    version: Literal[1] = 1
    files: dict[str, FileDigest]  # all other files, by their paths


def digest_of(path: Path) -> FileDigest:
    """Return the SHA-256 and the size of a file, which is read piece by piece."""
    sha256 = hashlib.sha256()
    size = 0
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            sha256.update(chunk)
            size += len(chunk)
    return FileDigest(sha256=sha256.hexdigest(), size=size)


def pack(folder: Path, archive: Path) -> str:
    """Write all files of `folder` into the bundle `archive`; if that fails, no file is written. The
    same files give the same bytes.

    Returns:
        The SHA-256 of the manifest, which identifies the content of the bundle.
    """
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    names = {path.relative_to(folder).as_posix(): path for path in paths}
    unknown = [name for name in names if not _KNOWN.fullmatch(name) or name == MANIFEST]
    if unknown:
        raise ConfigError(
            f"{folder}: expected only files of results, got {unknown[:5]}; rename or remove them"
        )

    manifest = Manifest(files={name: digest_of(path) for name, path in names.items()})
    text = (manifest.model_dump_json(indent=1) + "\n").encode()
    with (
        storage.whole(archive) as unfinished_path,
        zipfile.ZipFile(unfinished_path, "w", zipfile.ZIP_DEFLATED) as file,
    ):
        file.writestr(_member(MANIFEST), text, zipfile.ZIP_DEFLATED)
        for name, path in names.items():
            is_compressed = path.suffix in (".mp4", ".npz")
            member = _member(name, zipfile.ZIP_STORED if is_compressed else zipfile.ZIP_DEFLATED)
            with path.open("rb") as source, file.open(member, "w", force_zip64=True) as target:
                shutil.copyfileobj(source, target, _CHUNK)
    return hashlib.sha256(text).hexdigest()


def _member(name: str, compression: int = zipfile.ZIP_DEFLATED) -> zipfile.ZipInfo:
    # The first date that ZIP allows, as the time is not part of the results.
    member = zipfile.ZipInfo(name)
    member.compress_type = compression
    member.external_attr = (stat.S_IFREG | 0o644) << 16
    return member


def require_file(archive: Path) -> None:
    """Raise `ConfigError` unless `archive` is a file."""
    if (archive / DATABASE).is_file():
        raise ConfigError(
            f"{archive}: expected a bundle, got a folder of results; `vlagents-ray bundle "
            f"{archive}` writes its bundle"
        )
    if not archive.is_file():
        actual = "a folder" if archive.is_dir() else "no file"
        raise ConfigError(
            f"{archive}: expected a bundle, a file that `vlagents-ray bundle` wrote, got {actual}"
        )


def unpack(archive: Path, folder: Path, *, most_bytes: int = MOST_BYTES) -> str:
    """Write the files of a bundle into `folder`, without its manifest.

    Returns:
        The SHA-256 of the manifest, which identifies the content.

    Raises:
        ConfigError: The file is not a bundle, or is larger than allowed, or has a name that leads
            out of `folder`, or has other files than its manifest lists.
    """
    require_file(archive)
    try:
        with zipfile.ZipFile(archive) as file:
            members = _checked(archive, file, most_bytes)
            manifest, sha256 = _manifest(archive, file, members.pop(MANIFEST, None))

            digests: dict[str, FileDigest] = {}
            for name, member in members.items():
                target = folder / name
                target.parent.mkdir(parents=True, exist_ok=True)
                with file.open(member) as source, target.open("xb") as written:
                    digests[name] = _copy(archive, source, written, member)
    except ConfigError:
        raise
    except _BROKEN as error:
        raise ConfigError(
            f"{archive}: cannot be read as a bundle ({error}); copy it again from its source"
        ) from error

    listed = manifest.files
    names = listed.keys() | digests.keys()
    differing = sorted(name for name in names if listed.get(name) != digests.get(name))
    if differing:
        raise ConfigError(
            f"{archive}: expected the files that {MANIFEST} lists, got others "
            f"({', '.join(differing[:_SHOWN])}); copy the bundle again from its source"
        )
    return sha256


def _checked(archive: Path, file: zipfile.ZipFile, most_bytes: int) -> dict[str, zipfile.ZipInfo]:
    """Return the members by their names, after all checks that do not need the content."""
    listed = file.infolist()
    if len(listed) > _MOST_MEMBERS:
        raise ConfigError(
            f"{archive}: expected at most {_MOST_MEMBERS} files, got {len(listed)}; {_DISTRUST}"
        )

    members: dict[str, zipfile.ZipInfo] = {}
    for member in listed:
        name = member.orig_filename
        kind = stat.S_IFMT(member.external_attr >> 16)
        if not _KNOWN.fullmatch(name) or member.filename != name:
            raise ConfigError(
                f"{archive}: expected only files of results, got {name!r}; {_DISTRUST}"
            )
        if name in members:
            raise ConfigError(
                f"{archive}: expected each file once, got {name!r} twice; {_DISTRUST}"
            )
        if kind not in (0, stat.S_IFREG):
            raise ConfigError(f"{archive}: {name!r} is a link or another special file; {_DISTRUST}")
        is_encrypted = member.flag_bits & 0x1
        if is_encrypted or member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ConfigError(
                f"{archive}: {name!r} is encrypted, or not compressed like a bundle; {_DISTRUST}"
            )
        members[name] = member

    total = sum(member.file_size for member in listed)
    if total > most_bytes:
        raise ConfigError(
            f"{archive}: expected at most {most_bytes} unpacked bytes, got {total}; allow more "
            "with --max-gb if you trust it"
        )
    return members


def _manifest(
    archive: Path, file: zipfile.ZipFile, member: zipfile.ZipInfo | None
) -> tuple[Manifest, str]:
    """Return the manifest and its SHA-256."""
    if member is None:
        raise ConfigError(
            f"{archive}: expected a bundle that `vlagents-ray bundle` wrote, got one without "
            f"{MANIFEST}"
        )
    if member.file_size > _MOST_MANIFEST:
        raise ConfigError(
            f"{archive}: {MANIFEST}: expected at most {_MOST_MANIFEST} bytes, got "
            f"{member.file_size}"
        )

    with file.open(member) as opened:
        text = opened.read(_MOST_MANIFEST + 1)
    try:
        return Manifest.model_validate_json(text), hashlib.sha256(text).hexdigest()
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ConfigError(
            f"{archive}: {MANIFEST} is not one of version 1: {where}: {first['msg']}; read it with "
            "the version of vlagents-ray that wrote it"
        ) from error


def _copy(
    archive: Path, source: IO[bytes], target: IO[bytes], member: zipfile.ZipInfo
) -> FileDigest:
    """Copy a member of the bundle, and return its digest."""
    sha256 = hashlib.sha256()
    size = 0
    while chunk := source.read(_CHUNK):
        size += len(chunk)
        if size > member.file_size:
            raise ConfigError(
                f"{archive}: {member.filename!r} has more bytes than its declared size; {_DISTRUST}"
            )
        sha256.update(chunk)
        target.write(chunk)
    return FileDigest(sha256=sha256.hexdigest(), size=size)


def write_bundle(folder: Path, archive: Path, *, videos: bool = False) -> str:
    """Write the results in `folder` as one file that others can reproduce (`verify`).

    The bundle contains the present results.db, the differences from the commits, and the
    trajectories, with which episodes are replayed, but nothing that is computed from these. The
    database names only files in the bundle, so that the bundle's results can be merged with others.

    Args:
        folder: A folder of results, to which an evaluation may be writing; nothing in it is
            changed.
        videos: Whether the bundle also contains the videos of the report and of the policy's
            images.

    Returns:
        The SHA-256 of the bundle's manifest, which identifies its content.

    Raises:
        ConfigError: The folder has no results, or one of its files is outside of the folder.
        StorageFailed: The disk is full, or cannot be written to.
    """
    with storage.storing(archive.parent):
        archive.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(
            prefix=f"{archive.name}.part-", dir=archive.parent
        ) as temporary:
            stage = Path(temporary)
            # The copy is consistent, even while an evaluation writes to the database.
            with reading(folder) as source, closing(sqlite3.connect(stage / DATABASE)) as target:
                source.backup(target)

            _link_files(folder, stage, Results.load(stage), videos=videos)
            _forget_missing_files(stage)
            return pack(stage, archive)


def _forget_missing_files(stage: Path) -> None:
    """Remove names from the database whose files are not in the folder."""
    with closing(sqlite3.connect(stage / DATABASE)) as db, db:
        rows = db.execute("SELECT key, videos, trajectory FROM episodes").fetchall()
        for key, videos, trajectory in rows:
            present_videos = [path for path in json.loads(videos) if (stage / path).is_file()]
            has_trajectory = trajectory and (stage / trajectory).is_file()
            values = (canonical(present_videos), trajectory if has_trajectory else None, key)
            db.execute("UPDATE episodes SET videos = ?, trajectory = ? WHERE key = ?", values)


def _link_files(folder: Path, stage: Path, results: Results, *, videos: bool) -> None:
    """Link the files of the episodes, and those with the differences from commits, into the folder
    `stage`.
    """
    paths: list[str] = []
    for case in results.cases:
        for episode in case.episodes:
            if videos:
                paths += episode.videos
            if episode.trajectory is not None:
                paths.append(episode.trajectory)
                if videos:
                    paths += storage.trajectory_videos(folder, episode.trajectory)

    diffs = sorted((folder / storage.PROVENANCE).glob("*.diff"))
    paths += [f"{storage.PROVENANCE}/{diff.name}" for diff in diffs]

    for path in dict.fromkeys(paths):
        source = storage.inside(folder, path)
        if source.is_file():  # a folder that was copied without its videos can also be bundled
            storage.link_or_copy(source, stage / path)
