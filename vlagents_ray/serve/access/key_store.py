"""The file of API keys: a JSON document with the hash and the permissions of each key, without the
keys themselves.

    {"keys": [{"name": "arm-1", "sha256": "9f86…", "apps": ["pi0"], "rate": 60, "sessions": 2,
               "priority": "robot", "scopes": ["weights"], "expires": 1798675200,
               "revoked": false}]}

All fields but `name` and `sha256` are optional. `rate` is in requests/s, `expires` in seconds since
1970 (UTC).
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
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError, shown
from vlagents_ray.naming import did_you_mean, without_duplicate_keys
from vlagents_ray.protocol.messages import PRIORITIES, PriorityName

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
# Rights of a key in addition to using the policy: `weights` to push new weights, `watch` to watch
# all sessions on the live page, and `operate` to press its buttons, which pause or stop a robot, or
# mark or save its episode.
SCOPES = ("weights", "watch", "operate")
_PREFIX = "vlr_"  # allows scanners of repositories and logs to find leaked keys


@dataclass(frozen=True, slots=True)
class Key:
    """The permissions of one key."""

    name: str
    sha256: str  # SHA-256 of the key's UTF-8 text, 64 hexadecimal digits
    apps: tuple[str, ...] = ()  # applications for which the key is valid; empty for all
    rate: float | None = None  # maximum rate, requests/s
    sessions: int | None = None  # maximum number of simultaneous sessions
    # "simulation" applies to all requests of the key; otherwise each request sets its priority.
    priority: PriorityName | None = None
    scopes: tuple[str, ...] = ()  # a subset of `SCOPES`
    expires: float | None = None  # time of expiry, s since 1970
    revoked: bool = False

    def __post_init__(self) -> None:
        """Raise `ConfigError` if a field is invalid."""
        if not isinstance(self.name, str) or not _NAME.fullmatch(self.name):
            raise ConfigError(
                f"key name: expected 1 to 64 letters, digits, '.', '_' or '-', got {self.name!r}"
            )
        if not isinstance(self.sha256, str) or not _SHA256.fullmatch(self.sha256):
            raise ConfigError(
                f"key {self.name!r}: sha256: expected 64 hexadecimal digits, got others; make the "
                "key with `keys create`"
            )
        if not all(isinstance(app, str) for app in self.apps):
            raise ConfigError(
                f"key {self.name!r}: apps: expected names of applications, got {self.apps!r}"
            )

        self._require_positive("rate", int, float)
        self._require_positive("sessions", int)
        self._require_positive("expires", int, float)

        if self.priority is not None and self.priority not in PRIORITIES:
            meant = did_you_mean(str(self.priority), PRIORITIES)
            raise ConfigError(
                f"key {self.name!r}: priority: expected one of {list(PRIORITIES)}, got "
                f"{self.priority!r}{meant}"
            )
        unknown = sorted(map(str, set(self.scopes) - set(SCOPES)))
        if unknown:
            meant = "".join(did_you_mean(scope, SCOPES) for scope in unknown)
            raise ConfigError(
                f"key {self.name!r}: scopes: expected only {list(SCOPES)}, got {unknown}{meant}"
            )
        if not isinstance(self.revoked, bool):
            raise ConfigError(
                f"key {self.name!r}: revoked: expected true or false, got {self.revoked!r}"
            )

    def _require_positive(self, field: str, *types: type) -> None:
        """Raise `ConfigError` unless a field is None or a positive number of one of the types."""
        value = getattr(self, field)
        if value is None:
            return
        is_number = isinstance(value, types) and not isinstance(value, bool)
        if not is_number or not 0 < value < 1e12:
            raise ConfigError(
                f"key {self.name!r}: {field}: expected a positive number, got {value!r}"
            )


def parse_keys(text: str, where: str = "keys") -> list[Key]:
    """Return the keys in the text of a key file.

    Args:
        text: The text.
        where: The name of the file in messages.

    Raises:
        ConfigError: The text is invalid, or two keys have the same name.
    """
    try:
        document = json.loads(text, object_pairs_hook=without_duplicate_keys)
        entries = document["keys"]
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ConfigError(
            f'{where}: expected a JSON document {{"keys": [...]}}, as `vlagents-ray keys create` '
            f"writes it ({error})"
        ) from error
    if not isinstance(entries, list):
        raise ConfigError(f"keys: expected a list, got {type(entries).__name__}")

    keys = [_parse(entry) for entry in entries]
    names = [key.name for key in keys]
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise ConfigError(
            f"keys: expected different names, got {double} more than once; rename all but one"
        )
    return keys


def _parse(entry: Any) -> Key:
    if not isinstance(entry, dict) or not {"name", "sha256"} <= entry.keys():
        raise ConfigError(
            f"keys: expected an object with 'name' and 'sha256' at least, got {shown(entry)}"
        )

    known = {field.name for field in fields(Key)}
    unknown = entry.keys() - known
    if unknown:
        meant = "".join(did_you_mean(field, known) for field in unknown)
        raise ConfigError(
            f"key {entry['name']!r}: expected only {sorted(known)}, got {sorted(unknown)}{meant}"
        )

    values = dict(entry)
    for field in ("apps", "scopes"):
        names = entry.get(field) or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ConfigError(
                f"key {entry['name']!r}: {field}: expected a list of names, got {names!r}"
            )
        values[field] = tuple(names)
    return Key(**values)


def read_text(file: Path) -> str:
    """Return the text of a key file; raise `ConfigError` if it does not exist or cannot be read."""
    try:
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"keys file {file}: cannot be read ({error.strerror}); `vlagents-ray keys create` "
            "creates it"
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"keys file {file}: cannot be read, since it is not UTF-8 ({error.reason})"
        ) from error


def read_keys(file: Path) -> list[Key]:
    """Return the keys in a file; an empty list if there is no such file."""
    try:
        return parse_keys(read_text(file), f"keys file {file}")
    except ConfigError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            return []
        raise


def new_key(file: Path, name: str, **allowed: Any) -> str:
    """Generate a key, add its hash to the file, and return the key, which is not stored.

    Args:
        file: The key file; a new file is readable by its owner only.
        name: The name of the key; the name of a revoked key may be used again.
        allowed: The other fields of `Key`.

    Raises:
        ConfigError: The name is in use, a field is invalid, the key would have expired already, or
            the file cannot be changed.
    """
    expires = allowed.get("expires")
    if expires is not None and expires <= time.time():
        raise ConfigError(
            f"key {name!r}: expires: expected a time in the future, got {expires:.0f} s since 1970"
        )
    token = _PREFIX + secrets.token_urlsafe(32)
    key = Key(name, hashlib.sha256(token.encode()).hexdigest(), **allowed)

    def add(keys: list[Key]) -> list[Key]:
        """Return the keys and the new key, which replaces a revoked key of the same name."""
        if any(other.name == name and not other.revoked for other in keys):
            raise ConfigError(
                f"key {name!r} exists already; choose another name, or revoke it first"
            )
        return [*(other for other in keys if other.name != name), key]

    _change(file, add)
    return token


def revoke(file: Path, name: str) -> None:
    """Mark a key as revoked, which running servers detect within seconds.

    Raises:
        ConfigError: There is no key of this name.
    """

    def mark(keys: list[Key]) -> list[Key]:
        """Return the keys, with the key `name` revoked."""
        if all(key.name != name for key in keys):
            have = sorted(key.name for key in keys)
            raise ConfigError(
                f"no key {name!r} in {file}; there are {have}{did_you_mean(name, have)}"
            )
        return [replace(key, revoked=True) if key.name == name else key for key in keys]

    _change(file, mark)


def _change(file: Path, change: Callable[[list[Key]], list[Key]]) -> None:
    """Read, change and replace the file as a whole, so that a server never reads a partial file.

    The new file has the owner of the old file; otherwise a server could not read it, and would
    accept the old keys for some time. If the owner cannot be preserved, nothing is changed and
    `ConfigError` is raised.
    """
    with _locked(file) as folder:
        keys = change(read_keys(file))
        text = json.dumps({"keys": [_to_json(key) for key in keys]}, indent=2) + "\n"

        descriptor, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
        try:
            with os.fdopen(descriptor, "w", encoding="utf-8") as written:
                _copy_owner(descriptor, file)
                written.write(text)
                written.flush()
                os.fsync(descriptor)
            Path(name).replace(file)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
        os.fsync(folder)  # a revocation must survive a power failure


def _to_json(key: Key) -> dict[str, Any]:
    """Return the fields of a key that differ from their defaults."""
    return {name: value for name, value in asdict(key).items() if value not in (None, (), False)}


def _copy_owner(descriptor: int, file: Path) -> None:
    """Give the open file `descriptor` the owner, group and mode of `file`, which it is about to
    replace.
    """
    try:
        old = file.stat()
    except FileNotFoundError:
        os.fchmod(descriptor, 0o600)
        return
    new = os.fstat(descriptor)
    try:
        if (old.st_uid, old.st_gid) != (new.st_uid, new.st_gid):
            os.fchown(descriptor, old.st_uid, old.st_gid)
        os.fchmod(descriptor, old.st_mode & 0o777)
    except OSError as error:
        raise ConfigError(
            f"keys file {file}: belongs to user {old.st_uid} (group {old.st_gid}), and the new "
            f"file cannot be given this owner ({error.strerror}); nothing was changed: run this as "
            "that user, or as root"
        ) from error


@contextlib.contextmanager
def _locked(file: Path) -> Iterator[int]:
    """Return a context manager that locks the file's folder, so that no change is lost if two
    commands change the file. It yields the descriptor of the folder.
    """
    try:
        descriptor = os.open(file.parent, os.O_RDONLY)
    except OSError as error:
        raise ConfigError(f"keys file {file}: no such folder ({error.strerror})") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield descriptor
    finally:
        os.close(descriptor)
