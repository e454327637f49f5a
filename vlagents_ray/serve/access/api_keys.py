"""API keys and their permissions, without sockets or Ray.

A key is 256 random bits (`vlagents_ray.serve.access.key_store.new_key`); the server stores its
SHA-256. Slow password hashes are necessary only for passwords that people choose, since such
passwords can be guessed. Therefore users cannot choose keys: random keys need no slow hash, which
would take longer than the policy at every request.

Limits apply per replica and per gateway: two replicas together allow a key twice its rate and
sessions.
"""

from __future__ import annotations

import enum
import hashlib
import hmac
import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from vlagents_ray.client.credentials import KEY_VARIABLE
from vlagents_ray.errors import ConfigError, Forbidden, TooManyRequests, Unauthorized, VLAgentsError
from vlagents_ray.protocol.messages import PriorityName, is_loopback
from vlagents_ray.serve.access.audit import Audit
from vlagents_ray.serve.access.key_store import Key, parse_keys, read_text
from vlagents_ray.serve.access.variables import FILE_VARIABLE, TEXT_VARIABLE
from vlagents_ray.serve.token_bucket import TokenBucket

logger = logging.getLogger(__name__)

_KEY_PROTOCOL = "vlagents.key."  # prefix of the WebSocket subprotocol that contains a key
# Minimum and maximum time for which connections of a key over its rate are not read, s.
_THROTTLED_S = (0.05, 1.0)
_CHECK_S = 1.0  # minimum time between two checks of the file
# Maximum time for which a request waits for a check, s. A network drive that hangs delays one
# request, possibly on the policy's thread.
_WAIT_S = 0.25
_CLOSE_S = 300.0  # time for which the keys stay valid while the file cannot be read
_REMIND_S = 60.0  # time between two log lines about an unreadable file
_UNREAD = object()  # the stamp of a file that could not be read, so that each check tries again


class NoKey(enum.Enum):
    """The reason why a request needs no API key, used in place of a `Caller`."""

    OPEN = "the server has no keys"
    INSIDE = "the request comes from the same Ray cluster, or from the replica itself"


class Keys:
    """The keys of a server, read again when their file changes; thread-safe.

    If the file is deleted, all keys are rejected. If it cannot be read or parsed, the keys stay
    valid for `_CLOSE_S`, so that an editing mistake or a short failure of a network drive does not
    stop a robot; the log and a metric report it immediately. After that time, all keys are rejected
    until the file can be read, since some keys may have been revoked.
    """

    def __init__(
        self, read: Callable[[], str], changed: Callable[[], object], where: str = "keys"
    ) -> None:
        """Read the keys.

        Args:
            read: Returns the text of the key file.
            changed: Returns an object that differs when the text may have changed.
            where: The name of the key file in messages.
        """
        self._read = read
        self._changed = changed
        self._where = where
        self._lock = threading.Lock()
        self.audit = Audit()

        self._keys: dict[bytes, Key] = {}  # keys by their SHA-256
        self._buckets: dict[str, TokenBucket] = {}
        # Time until which no connection of a key is read, s, by the key's name.
        self._unread_until: dict[str, float] = {}
        self._connections: Counter[str] = Counter()  # number of connections, by the key's name

        self._checked = float("-inf")  # time of the last check of the file, s
        # Time since which the file is unreadable, s; None if it is readable.
        self._unreadable: float | None = None
        self._reminded = 0.0  # time of the last log line about an unreadable file, s
        self._hung: threading.Thread | None = None  # thread of a check that has not returned
        self._state: object = self._changed()
        self._load(self._read())

    @classmethod
    def from_file(cls, path: str | Path) -> Keys:
        """Read the keys from a file, which is then checked for changes.

        Raises:
            ConfigError: The file is not a key file.
        """
        file = Path(path)
        return cls(lambda: read_text(file), lambda: _stamp(file), where=f"keys file {file}")

    @classmethod
    def from_text(cls, text: str) -> Keys:
        """Read the keys from the text of a key file. They cannot be revoked while this process
        runs.
        """
        return cls(lambda: text, lambda: None)

    def check(self, token: str | None, app: str) -> Caller:
        """Return the caller with the key `token`, for the application `app`.

        Raises:
            Unauthorized: The key is missing, unknown, revoked or expired.
            Forbidden: The key is for other applications.
        """
        if not token:
            self.audit.refused("", "no key")
            raise Unauthorized(
                f"this server needs an API key: set {KEY_VARIABLE}, api_key= (Python, C++) or the "
                "header 'Authorization: Bearer KEY' (HTTP)"
            )

        self._refresh()
        digest = hashlib.sha256(token.encode(errors="surrogateescape")).digest()
        keys = self._keys  # another thread may replace the attribute
        key: Key | None = None
        # The digest is compared with the digests of all keys, so that the duration reveals nothing
        # about the keys.
        for known_digest, known_key in keys.items():
            if hmac.compare_digest(known_digest, digest):
                key = known_key
        if key is None:
            self.audit.refused("", "an unknown key")
            raise Unauthorized("the server has no such API key; ask its operator for one")

        caller = Caller(self, digest, key.name, app)
        caller.require()
        return caller

    def key(self, digest: bytes) -> Key | None:
        """Return the key with this SHA-256 in the current file, or None."""
        self._refresh()
        return self._keys.get(digest)

    def take(self, key: Key) -> None:
        """Count a request of `key`; raise `TooManyRequests` if the key is over its rate."""
        if key.rate is None:
            return

        now = time.monotonic()
        with self._lock:
            wait_s = self._bucket(key.name, key.rate, now).take(now)
            if wait_s > 0:
                shortest_s, longest_s = _THROTTLED_S
                self._unread_until[key.name] = now + min(longest_s, max(shortest_s, wait_s))

        if wait_s > 0:
            error = TooManyRequests(
                f"key {key.name!r}: over {key.rate:g} requests a second; wait {wait_s:.2g} s, send "
                "fewer, or ask the operator of the server for a key with a higher rate"
            )
            error.retry_after_s = wait_s
            raise error

    def owe(self, key: Key, requests: float) -> None:
        """Count `requests` more requests of `key`, which have been executed."""
        if key.rate is not None:
            now = time.monotonic()
            with self._lock:
                self._bucket(key.name, key.rate, now).owe(now, requests)

    def _bucket(self, name: str, rate: float, now: float) -> TokenBucket:
        """Return the bucket of a key with a rate; the caller holds the lock."""
        bucket = self._buckets.get(name)
        if bucket is None or bucket.rate != rate:
            bucket = self._buckets[name] = TokenBucket(rate, now)
            self._unread_until.pop(name, None)
        return bucket

    def throttled_s(self, name: str) -> float:
        """Return the time for which the key's connections are not read, s; 0 if the key has not
        exceeded its rate.
        """
        return max(0.0, self._unread_until.get(name, 0.0) - time.monotonic())

    def hold(self, name: str, number: int, limit: int | None) -> None:
        """Count `number` more connections of a key.

        Raises:
            TooManyRequests: The key would exceed `limit`; no connection is counted.
        """
        with self._lock:
            connections = self._connections[name]
            if limit is not None and number > 0 and connections + number > limit:
                raise TooManyRequests(
                    f"key {name!r} has {connections} connections here and may hold {limit} sessions"
                )
            self._connections[name] = connections + number
            if self._connections[name] <= 0:
                del self._connections[name]

    @property
    def unreadable_s(self) -> float:
        """Time since which the file is unreadable, s; 0 if it is readable."""
        self._refresh()
        since = self._unreadable
        return 0.0 if since is None else time.monotonic() - since

    def _refresh(self) -> None:
        """Check whether the file has changed, at most every `_CHECK_S`."""
        now = time.monotonic()
        if now - self._checked < _CHECK_S:
            return

        with self._lock:
            if now - self._checked < _CHECK_S:  # another thread has just checked the file
                return
            self._checked = now

            if self._hung is None:
                reader = threading.Thread(
                    target=self._read_again, args=(now,), name="keys", daemon=True
                )
                reader.start()
                reader.join(_WAIT_S)
                self._hung = reader if reader.is_alive() else None
            elif self._hung.is_alive():
                self._handle_unreadable(
                    TimeoutError(f"its file system has not answered for {_WAIT_S:g} s"), now
                )
            else:
                self._hung = None

    def _read_again(self, now: float) -> None:
        """Read the file if it has changed. This method runs on a separate thread, since a network
        drive may block.
        """
        try:
            state = self._changed()
            if state == self._state:
                return
            self._load(None if state is None else self._read())
        except Exception as error:  # noqa: BLE001 - neither the file's content nor a disk error may fail a request
            self._handle_unreadable(error, now)
            return

        self._state = state
        if self._unreadable is not None:
            logger.warning("the key file can be read again")
            self._unreadable = None

    def _handle_unreadable(self, error: Exception, now: float) -> None:
        """Log that the file is unreadable, and reject all keys if it has been unreadable for
        `_CLOSE_S`.
        """
        is_first = self._unreadable is None
        if self._unreadable is None:
            self._unreadable = now
        self._state = _UNREAD

        left_s = _CLOSE_S - (now - self._unreadable)
        if left_s <= 0 and self._keys:
            self._keys = {}
            logger.critical(
                "all keys are rejected, as no key file could be read for %g s: %s", _CLOSE_S, error
            )
        elif is_first or now - self._reminded >= _REMIND_S:
            if left_s > 0:
                consequence = f"the current keys stay valid for {left_s:.0f} s more"
            else:
                consequence = "all keys are rejected"
            logger.error("the key file cannot be read; %s: %s", consequence, error)
        else:
            return
        self._reminded = now

    def _load(self, text: str | None) -> None:
        """Replace the keys with the keys in the text of a key file; remove all keys if the text is
        None.
        """
        keys = [] if text is None else parse_keys(text, self._where)
        self._keys = {bytes.fromhex(key.sha256): key for key in keys}


@dataclass(frozen=True, slots=True)
class Caller:
    """The holder of a key, for one connection; each request looks up the key's permissions."""

    _keys: Keys
    _digest: bytes
    name: str  # name of the key; keys with other names cannot use its sessions
    app: str

    @property
    def priority(self) -> PriorityName | None:
        """The highest priority of the caller's requests; None for any priority."""
        key = self._keys.key(self._digest)
        return None if key is None else key.priority

    @property
    def sessions(self) -> int | None:
        """Maximum number of sessions that the key may hold at one replica; None for any number."""
        key = self._keys.key(self._digest)
        return 0 if key is None else key.sessions

    def require(self, scope: str | None = None) -> Key:
        """Check the key, and return what it permits now; nothing is charged.

        Args:
            scope: The scope that the key needs; None if it needs no scope.

        Raises:
            Unauthorized: The key is revoked or has expired.
            Forbidden: The key is no longer for this application, or lacks the scope.
        """
        try:
            return self._valid_key(scope)
        except VLAgentsError as error:
            self._keys.audit.refused(self.name, error.code)
            raise

    def take_request(self) -> Key:
        """Check the key as `require` does, and count one request towards its rate.

        Only `vlagents_ray.serve.access.charges` calls this, for all endpoints.

        Raises:
            Unauthorized: The key is revoked or has expired.
            Forbidden: The key is no longer for this application.
            TooManyRequests: The key is over its rate.
        """
        try:
            key = self._valid_key()
            self._keys.take(key)
        except VLAgentsError as error:
            self._keys.audit.refused(self.name, error.code)
            raise
        return key

    def owe(self, requests: float) -> None:
        """Count `requests` more requests towards the rate of the key, without rejecting them."""
        key = self._keys.key(self._digest)
        if key is not None:
            self._keys.owe(key, requests)

    def refusal(self, scope: str | None = None) -> str | None:
        """Return the reason why the key is no longer valid or lacks the `scope`; None if it is
        valid.
        """
        try:
            self._valid_key(scope)
        except VLAgentsError as error:
            return str(error)
        return None

    def throttled_s(self) -> float:
        """Return the time for which no connection of this key is read, s; 0 if the key is within
        its rate.

        Receiving a message that is then rejected costs time on any connection, so the pause applies
        to the key and not to one connection.
        """
        return self._keys.throttled_s(self.name)

    def require_unthrottled(self) -> None:
        """Raise `TooManyRequests` for a new connection while the key's connections are not read."""
        wait_s = self.throttled_s()
        if wait_s > 0:
            self._keys.audit.refused(self.name, TooManyRequests.code)
            error = TooManyRequests(
                f"key {self.name!r}: over its rate; connect again after {wait_s:.2g} s"
            )
            error.retry_after_s = wait_s
            raise error

    def hold(self, number: int = 1) -> None:
        """Count `number` more connections of the key, or fewer if `number` is negative.

        Raises:
            TooManyRequests: The key would have more connections than sessions.
        """
        try:
            self._keys.hold(self.name, number, self.sessions)
        except TooManyRequests as error:
            self._keys.audit.refused(self.name, error.code)
            raise

    def note(self, event: str, subject: str) -> None:
        """Log an action of the key, see `Audit.did`."""
        self._keys.audit.did(self.name, event, subject)

    def _valid_key(self, scope: str | None = None) -> Key:
        key = self._keys.key(self._digest)
        if key is None or key.revoked:
            raise Unauthorized(
                f"key {self.name!r} was revoked; ask the operator of the server for another key"
            )
        if key.expires is not None and time.time() >= key.expires:
            raise Unauthorized(
                f"key {self.name!r} has expired; ask the operator of the server for another key"
            )
        if key.apps and self.app not in key.apps:
            raise Forbidden(f"key {self.name!r} is for {sorted(key.apps)}, not for {self.app!r}")
        if scope is not None and scope not in key.scopes:
            raise Forbidden(
                f"key {self.name!r}: expected the scope {scope!r}, which this key lacks; use a "
                f"key of `keys create NAME --scope {scope}`"
            )
        return key


def load_keys(file: str | None = None, environment: Mapping[str, str] = os.environ) -> Keys | None:
    """Load the keys in `file` or, if it is None, the keys in the environment; return None if there
    are none.

    In the environment, `VLAGENTS_RAY_KEYS_FILE` is the path of a key file, and `VLAGENTS_RAY_KEYS`
    is the text of one.
    """
    path = file or environment.get(FILE_VARIABLE)
    if path:
        return Keys.from_file(path)
    text = environment.get(TEXT_VARIABLE)
    return Keys.from_text(text) if text else None


def token_of(headers: Mapping[str, str]) -> str | None:
    """Return the key of a request: `Authorization: Bearer KEY`, `Authorization: Api-Key KEY` or
    `x-api-key: KEY`.

    openpi's client sends the second form. A page in a browser, which cannot set headers of a
    WebSocket, sends the key among its subprotocols, as `vlagents.key.KEY`. The names in `headers`
    must be in lower case.
    """
    kind, _, token = headers.get("authorization", "").strip().partition(" ")
    if kind.lower() in ("bearer", "api-key") and token.strip():
        return token.strip()

    key = headers.get("x-api-key")
    if key:
        return key
    for protocol in headers.get("sec-websocket-protocol", "").split(","):
        name = protocol.strip()
        if name.startswith(_KEY_PROTOCOL):
            return name.removeprefix(_KEY_PROTOCOL)
    return None


# The sender of requests: the holder of a key, or the reason why no key is needed.
Identity = Caller | NoKey

_CALLER: ContextVar[Identity] = ContextVar("vlagents_ray_caller")


def current_caller() -> Identity:
    """Return the caller of the request that this task processes.

    Raises:
        LookupError: The task runs outside `on_behalf_of`.
    """
    return _CALLER.get()


@contextmanager
def on_behalf_of(caller: Identity) -> Iterator[None]:
    """Make `caller` the current caller within the context, and in tasks that are started there."""
    token = _CALLER.set(caller)
    try:
        yield
    finally:
        _CALLER.reset(token)


def _stamp(file: Path) -> object:
    """Return an object that changes when the file is written or replaced; None if the file is
    gone.
    """
    try:
        stat = file.stat()
    except FileNotFoundError:
        return None
    return stat.st_mtime_ns, stat.st_ctime_ns, stat.st_size, stat.st_ino


def require_access(host: str, keys: Keys | None, insecure: bool) -> None:
    """Raise `ConfigError` if the server would accept other machines without keys and `insecure`
    does not allow that.
    """
    if keys is None and not insecure and not is_loopback(host):
        raise ConfigError(
            f"host {host}: any client that reaches this server could command the policy. Make keys "
            "(`vlagents-ray keys create NAME --keys keys.json`) and serve with `--keys keys.json` "
            "(in a deployment file: `access: {keys_file: PATH}` under `args`); or use "
            "`--insecure` (`access: {insecure: true}`)"
        )


def require_watch_keys(host: str, keys: Keys | None) -> None:
    """Raise `ConfigError` if other machines would reach a page on `host` without a key."""
    if keys is None and not is_loopback(host):
        raise ConfigError(
            f"live page on {host}: without keys all cameras would be public. Make a key "
            "(`vlagents-ray keys create NAME --scope watch --keys keys.json`) and set "
            "VLAGENTS_RAY_KEYS_FILE=keys.json; or stay on loopback, and look at it through "
            "`ssh -L`"
        )


def warn_of_plain_http(host: str) -> None:
    """Log a warning if API keys would cross a network unencrypted."""
    if not is_loopback(host):
        logger.warning(
            "host %s: API keys cross the network unencrypted, where others may read them. Serve "
            "with --tls-cert and --tls-key, or declare with --plain-http (`access: {plain_http: "
            "true}`) that TLS ends elsewhere",
            host,
        )


@dataclass(frozen=True, slots=True)
class ScopeCheck:
    """The check of the keys and scopes of requests to one endpoint."""

    subject: str  # the subject of the endpoint, for the error message
    # Whether other machines reach this server without a key; requests are then rejected.
    open_to_network: bool

    def require(self, scope: str) -> None:
        """Check the key of the current request, and its scope.

        Raises:
            Unauthorized: The key is revoked or has expired.
            Forbidden: The key lacks the scope, or the server has no keys and is open to other
                machines.
        """
        caller = current_caller()
        if isinstance(caller, Caller):
            caller.require(scope)
        elif self.open_to_network:
            raise Forbidden(
                f"{self.subject}: not available on a server with `--insecure`; make a key with "
                f"`vlagents-ray keys create NAME --scope {scope}` and serve with `--keys`, or "
                "serve on loopback without `--insecure`"
            )

    def may(self, scope: str) -> bool:
        """Return whether the current request has the scope, as `require` checks it."""
        caller = current_caller()
        if isinstance(caller, Caller):
            return caller.refusal(scope) is None
        return not self.open_to_network


def caller_name() -> str:
    """Return the name of the current request's key; empty without keys."""
    caller = current_caller()
    return caller.name if isinstance(caller, Caller) else ""
