"""Who may use a server: API keys, and what each of them allows. Pure: neither sockets nor Ray.

A key is 256 random bits (`vlagents_ray.serve.keyfile.new_key`), of which the server knows the SHA-256. That is
as good as a slow password hash: what makes one necessary, that people choose guessable passwords, does not
hold for random keys, and a slow hash at every request would cost a robot more than the policy. For the same
reason keys that are not ours are no use: their holders would choose them.

Limits hold for each replica by itself: two replicas let a key have twice its rate and sessions.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from vlagents_ray.errors import ConfigError, Forbidden, TooManyRequests, Unauthorized
from vlagents_ray.serve.keyfile import Key, parse_keys
from vlagents_ray.wire.messages import RankName

logger = logging.getLogger(__name__)

FILE_VARIABLE, TEXT_VARIABLE = "VLAGENTS_RAY_KEYS_FILE", "VLAGENTS_RAY_KEYS"
_LOOK_S = 1.0  # between two looks at the file
_CALLER: ContextVar[Caller | None] = ContextVar("vlagents_ray_caller", default=None)


class Keys:
    """The keys of a server, read again when their file changes. Thread-safe.

    A file that is gone lets nobody in. One that cannot be read, or holds nonsense, changes nothing, so that a
    slip of the editor or a network drive's bad moment stops no robot; the log says so.
    """

    def __init__(self, read: Callable[[], str], changed: Callable[[], object]) -> None:
        """`read` gives the text of a key file; `changed` anything that differs when the text may."""
        self._read = read
        self._changed = changed
        self._keys: dict[bytes, Key] = {}
        self._buckets: dict[str, _Bucket] = {}
        self._state: object = None
        self._looked = float("-inf")
        self._lock = threading.Lock()
        self._state = self._changed()
        self._take(self._read())

    @classmethod
    def from_file(cls, path: str | Path) -> Keys:
        """The keys in a file, which is watched; `ConfigError` if it is none."""
        file = Path(path)

        def read() -> str:
            try:
                return file.read_text()
            except OSError as error:
                raise ConfigError(
                    f"keys file {file}: cannot be read ({error.strerror}); `vlagents-ray keys new` makes one"
                ) from error

        return cls(read, lambda: _stamp(file))

    @classmethod
    def from_text(cls, text: str) -> Keys:
        """The keys in the text of a key file; none of them can be revoked while this process lives."""
        return cls(lambda: text, lambda: None)

    def check(self, token: str | None, app: str) -> Caller:
        """Whose key that is; `Unauthorized` for none or a wrong one, `Forbidden` for one of other applications."""
        if not token:
            raise Unauthorized("this server wants an API key; send the header 'Authorization: Bearer KEY'")
        self._look()
        digest = hashlib.sha256(token.encode(errors="surrogateescape")).digest()
        found: bytes | None = None
        keys = self._keys  # which another thread may replace
        for known in keys:  # all of them, whichever it is, so that the time tells nothing
            if hmac.compare_digest(known, digest):
                found = known
        if found is None:
            raise Unauthorized("this API key is not known here; ask whoever runs the server for one")
        caller = Caller(self, found, keys[found].name, app)
        caller.admit(free=True)
        return caller

    def key(self, digest: bytes) -> Key | None:
        """As the file has it now."""
        self._look()
        return self._keys.get(digest)

    def take(self, key: Key) -> None:
        """Count a request; `TooManyRequests` if it comes too fast."""
        if key.rate is None:
            return
        with self._lock:
            bucket = self._buckets.get(key.name)
            if bucket is None or bucket.rate != key.rate:
                bucket = self._buckets[key.name] = _Bucket(key.rate)
            wait_s = bucket.take(time.monotonic())
        if wait_s > 0:
            error = TooManyRequests(f"key {key.name!r}: over {key.rate:g} requests a second; wait {wait_s:.2g} s")
            error.retry_after_s = wait_s
            raise error

    def _look(self) -> None:
        now = time.monotonic()
        if now - self._looked < _LOOK_S:
            return
        with self._lock:
            if now - self._looked < _LOOK_S:
                return
            self._looked = now
            try:
                state = self._changed()
                if state == self._state:
                    return
                self._take(self._read() if state is not None else "")
                self._state = state
            except (OSError, ConfigError) as error:
                logger.error("the keys stay as they were: %s", error)  # noqa: TRY400 - the message says it all

    def _take(self, text: str) -> None:
        self._keys = {bytes.fromhex(key.sha256): key for key in (parse_keys(text) if text else ())}


@dataclass(frozen=True, slots=True)
class Caller:
    """Whoever holds a key, as long as a connection lasts; what the key allows is looked up at each request."""

    _keys: Keys
    _digest: bytes
    name: str  # of the key; sessions of one name are out of reach for all others
    app: str

    @property
    def rank(self) -> RankName | None:
        """The most urgent class that its requests may have; None for any."""
        key = self._keys.key(self._digest)
        return None if key is None else key.rank

    @property
    def sessions(self) -> int | None:
        """How many it may hold at one replica; None for any number."""
        key = self._keys.key(self._digest)
        return 0 if key is None else key.sessions

    def admit(self, *, free: bool = False) -> None:
        """Before each request, which counts unless it is `free`.

        `Unauthorized` once the key is revoked or has expired, `Forbidden` if it is no longer for this application,
        `TooManyRequests` if it asks too fast.
        """
        key = self._keys.key(self._digest)
        if key is None or key.revoked:
            raise Unauthorized(f"key {self.name!r} was revoked; ask whoever runs the server for another")
        if key.expires is not None and time.time() >= key.expires:
            raise Unauthorized(f"key {self.name!r} has expired; ask whoever runs the server for another")
        if key.apps and self.app not in key.apps:
            raise Forbidden(f"key {self.name!r} is for {sorted(key.apps)}, not for {self.app!r}")
        if not free:
            self._keys.take(key)


class _Bucket:
    """A token bucket that holds what one second brings, and one token at least."""

    def __init__(self, rate: float) -> None:
        self.rate = rate  # requests/s
        self._tokens = self._most = max(1.0, rate)
        self._filled = time.monotonic()

    def take(self, now: float) -> float:
        """0 if there is a token, which is taken; else the seconds until there is one."""
        self._tokens = min(self._most, self._tokens + (now - self._filled) * self.rate)
        self._filled = now
        if self._tokens < 1:
            return (1 - self._tokens) / self.rate
        self._tokens -= 1
        return 0.0


def load_keys(file: str | None = None, environment: Mapping[str, str] = os.environ) -> Keys | None:
    """The keys in `file`, else those that the environment names; None where there is neither.

    `VLAGENTS_RAY_KEYS_FILE` is the path of a key file, `VLAGENTS_RAY_KEYS` its text.
    """
    if file or (file := environment.get(FILE_VARIABLE)):
        return Keys.from_file(file)
    text = environment.get(TEXT_VARIABLE)
    return Keys.from_text(text) if text else None


def token_of(headers: Mapping[str, str]) -> str | None:
    """The key that a request brings: `Authorization: Bearer KEY`, `Authorization: Api-Key KEY` or `x-api-key: KEY`.

    The second is what openpi's client sends. The names in `headers` are in lower case.
    """
    kind, _, token = headers.get("authorization", "").strip().partition(" ")
    if kind.lower() in ("bearer", "api-key") and token.strip():
        return token.strip()
    return headers.get("x-api-key") or None


def current_caller() -> Caller | None:
    """Whose request this task works on; None where the server has no keys, or nobody asked from outside."""
    return _CALLER.get()


@contextmanager
def on_behalf_of(caller: Caller | None) -> Iterator[None]:
    """Inside, and in what is started there, `current_caller` gives this one."""
    token = _CALLER.set(caller)
    try:
        yield
    finally:
        _CALLER.reset(token)


def _stamp(file: Path) -> object:
    """Differs when the file was written or replaced; None if it is gone."""
    try:
        stat = file.stat()
    except FileNotFoundError:
        return None
    return stat.st_mtime_ns, stat.st_size, stat.st_ino


def is_loopback(host: str) -> bool:
    """Is this an address of this machine that no other machine reaches?"""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name
        return host == "localhost"


def require_access(host: str, keys: Keys | None, insecure: bool) -> None:
    """`ConfigError` if the server would let in anyone from other machines, and nobody has said that it shall."""
    if keys is None and not insecure and not is_loopback(host):
        raise ConfigError(
            f"host {host}: whoever reaches this server could command the policy. Make keys (`vlagents-ray keys new "
            f"NAME --file keys.json`) and serve with `--keys keys.json` (in a deployment file: "
            f"`access: {{keys_file: PATH}}` under `args`); or say `--insecure` (`access: {{insecure: true}}`)"
        )
