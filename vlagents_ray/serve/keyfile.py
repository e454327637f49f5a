"""The file of API keys: a JSON document with what is known of each, and no key.

    {"keys": [{"name": "arm-1", "sha256": "9f86…", "apps": ["pi0"], "rate": 60, "sessions": 2,
               "rank": "robot", "expires": 1798675200, "revoked": false}]}

All but `name` and `sha256` may be left out. `rate` is in requests/s, `expires` in seconds since 1970 (UTC).
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import re
import secrets
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.wire.messages import RANKS, RankName

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_PREFIX = "vlr_"  # so that scanners of repositories and logs can find keys that leaked


@dataclass(frozen=True, slots=True)
class Key:
    """What one key allows."""

    name: str
    sha256: str  # of the key's UTF-8 text, 64 hexadecimal digits
    apps: tuple[str, ...] = ()  # the applications that it is for; none named: all
    rate: float | None = None  # requests/s
    sessions: int | None = None  # held at once
    rank: RankName | None = None  # "simulation": all its requests are; else they say so themselves
    expires: float | None = None  # s since 1970
    revoked: bool = False

    def __post_init__(self) -> None:
        """`ConfigError` says what is wrong."""
        if not isinstance(self.name, str) or not _NAME.fullmatch(self.name):
            raise ConfigError(f"key name: got {self.name!r}, want 1 to 64 letters, digits, '.', '_' or '-'")
        if not isinstance(self.sha256, str) or not _SHA256.fullmatch(self.sha256):
            raise ConfigError(f"key {self.name!r}: sha256: want 64 hexadecimal digits, as `keys new` makes them")
        if not all(isinstance(app, str) for app in self.apps):
            raise ConfigError(f"key {self.name!r}: apps: got {self.apps!r}, want names of applications")
        for field, kinds in (("rate", (int, float)), ("sessions", (int,)), ("expires", (int, float))):
            value = getattr(self, field)
            if value is not None and (isinstance(value, bool) or not isinstance(value, kinds) or not 0 < value < 1e12):
                raise ConfigError(f"key {self.name!r}: {field}: got {value!r}, want a positive number")
        if self.rank is not None and self.rank not in RANKS:
            raise ConfigError(f"key {self.name!r}: rank: got {self.rank!r}, want one of {list(RANKS)}")
        if not isinstance(self.revoked, bool):
            raise ConfigError(f"key {self.name!r}: revoked: got {self.revoked!r}, want true or false")


def parse_keys(text: str) -> list[Key]:
    """The keys in the text of a file; `ConfigError` if it is none, or two share a name."""
    try:
        document = json.loads(text)
        entries = document["keys"]
    except (ValueError, TypeError, KeyError) as error:
        raise ConfigError('keys: want a JSON document {"keys": [...]}; `vlagents-ray keys new` writes one') from error
    if not isinstance(entries, list):
        raise ConfigError(f"keys: got {type(entries).__name__}, want a list")
    keys = [_parse(entry) for entry in entries]
    names = [key.name for key in keys]
    if double := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"keys: {double} stand there more than once; each needs a name of its own")
    return keys


def _parse(entry: Any) -> Key:
    if not isinstance(entry, dict) or not {"name", "sha256"} <= entry.keys():
        raise ConfigError(f"keys: got {str(entry)[:80]!r}, want an object with 'name' and 'sha256' at least")
    known = {field.name for field in fields(Key)}
    if unknown := entry.keys() - known:
        raise ConfigError(f"key {entry['name']!r}: unknown {sorted(unknown)}, want some of {sorted(known)}")
    apps = entry.get("apps") or []
    if not isinstance(apps, list):
        raise ConfigError(f"key {entry['name']!r}: apps: got {apps!r}, want a list")
    return Key(**{**entry, "apps": tuple(apps)})


def read_keys(file: Path) -> list[Key]:
    """The keys in a file; none if there is no such file."""
    try:
        return parse_keys(file.read_text())
    except FileNotFoundError:
        return []
    except OSError as error:
        raise ConfigError(f"keys file {file}: cannot be read ({error.strerror})") from error


def new_key(file: Path, name: str, **allowed: Any) -> str:
    """Make a key, add its hash to the file (made if need be, for its owner alone), and return the key, once.

    A name whose key was revoked may be given again. `allowed` are the other fields of `Key`.
    """
    token = _PREFIX + secrets.token_urlsafe(32)
    key = Key(name, hashlib.sha256(token.encode()).hexdigest(), **allowed)

    def add(keys: list[Key]) -> list[Key]:
        if any(other.name == name and not other.revoked for other in keys):
            raise ConfigError(f"key {name!r} is there already; choose another name, or revoke it first")
        return [*(other for other in keys if other.name != name), key]

    _change(file, add)
    return token


def revoke(file: Path, name: str) -> None:
    """Mark a key as revoked; running servers notice within seconds. `ConfigError` if there is none of that name."""

    def mark(keys: list[Key]) -> list[Key]:
        if all(key.name != name for key in keys):
            raise ConfigError(f"no key {name!r} in {file}; there are {sorted(key.name for key in keys)}")
        return [replace(key, revoked=True) if key.name == name else key for key in keys]

    _change(file, mark)


def _change(file: Path, change: Callable[[list[Key]], list[Key]]) -> None:
    """Read, change, and replace the file as a whole: a server never reads half of it."""
    with _locked(file):
        keys = change(read_keys(file))
        text = json.dumps({"keys": [_document(key) for key in keys]}, indent=2) + "\n"
        mode = file.stat().st_mode & 0o777 if file.exists() else 0o600
        descriptor, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
        try:
            with os.fdopen(descriptor, "w") as written:
                os.fchmod(descriptor, mode)
                written.write(text)
            Path(name).replace(file)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise


def _document(key: Key) -> dict[str, Any]:
    return {name: value for name, value in asdict(key).items() if value not in (None, (), False)}


@contextlib.contextmanager
def _locked(file: Path) -> Iterator[None]:
    """So that two commands at once lose neither's key."""
    try:
        descriptor = os.open(file.parent, os.O_RDONLY)
    except OSError as error:
        raise ConfigError(f"keys file {file}: no such folder ({error.strerror})") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
