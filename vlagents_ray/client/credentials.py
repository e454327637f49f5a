"""The credentials of a client: its API key and, for TLS, its certificate and the certificate
authorities that it trusts.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import ssl
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from urllib.parse import SplitResult, urlsplit

from vlagents_ray.errors import ConfigError, ConnectionLost, VLAgentsError
from vlagents_ray.protocol.messages import is_loopback

logger = logging.getLogger(__name__)

KEY_VARIABLE = "VLAGENTS_RAY_API_KEY"
WEBSOCKET_LOG = logging.getLogger("vlagents_ray.client.transports.websocket.protocol")
"""The logger for websockets. At the level DEBUG, websockets logs the headers that it sends; this
logger drops the lines that contain the key.
"""
WEBSOCKET_LOG.addFilter(lambda record: "authorization" not in str(record.args).lower())
_Path = str | os.PathLike[str]
# X509_V_ERR_HOSTNAME_MISMATCH and X509_V_ERR_IP_ADDRESS_MISMATCH: the certificate is for other
# names.
_NAME_MISMATCH_CODES = (62, 64)


@dataclass(frozen=True, slots=True)
class Credentials:
    """The credentials of a client: its API key, its certificate and private key, and the CA. All
    files are PEM files.
    """

    api_key: str | None = field(default=None, repr=False)
    ca: _Path | None = None
    certificate: tuple[_Path, _Path] | None = None

    def __post_init__(self) -> None:
        """Read the key from the environment if none was passed, and check the key."""
        key = os.environ.get(KEY_VARIABLE) if self.api_key is None else self.api_key
        if key is not None and not (key.isascii() and key.isprintable() and " " not in key):
            raise ConfigError(
                "api_key: expected visible ASCII characters without spaces, got other characters; "
                "pass the key exactly as `keys create` printed it"
            )
        object.__setattr__(self, "api_key", key or None)

    def become_default(self) -> None:
        """Make this key the default of the process, as if it were in the environment."""
        if self.api_key is not None:
            os.environ[KEY_VARIABLE] = self.api_key

    @property
    def headers(self) -> dict[str, str]:
        """The HTTP headers that carry the key."""
        return {} if self.api_key is None else {"authorization": f"Bearer {self.api_key}"}

    def use_at(self, url: str) -> None:
        """Warn if the key would be sent to this URL over a network without encryption."""
        parts = urlsplit(url)
        if self.api_key is not None and parts.scheme in ("http", "ws"):
            warn_of_plain_http(f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}")

    def context(self, url: str) -> ssl.SSLContext | None:
        """Return the TLS context for a URL; None if the URL is not encrypted.

        Raises:
            ConfigError: A file cannot be used.
        """
        if urlsplit(url).scheme not in ("https", "wss"):
            return None

        try:
            context = ssl.create_default_context(cafile=self.ca)
        except OSError as error:  # includes ssl.SSLError, a subclass
            raise ConfigError(
                f"TLS: ca={self.ca!r}: expected a file with the certificate of the CA that signed "
                f"the server's certificate, in PEM (the file begins with -----BEGIN "
                f"CERTIFICATE-----), got {error}"
            ) from error

        try:
            if self.certificate is not None:
                context.load_cert_chain(*self.certificate)
        except OSError as error:
            raise ConfigError(
                f"TLS: certificate={self.certificate!r}: expected this client's certificate and "
                f"its private key, two PEM files that belong together, got {error}"
            ) from error
        return context


ANONYMOUS = Credentials("")


@contextlib.contextmanager
def withheld() -> Iterator[None]:
    """Return a context manager that removes the key from the environment, so that processes that
    are started within it do not inherit the key.
    """
    key = os.environ.pop(KEY_VARIABLE, None)
    try:
        yield
    finally:
        if key is not None:
            os.environ[KEY_VARIABLE] = key


@cache
def warn_of_plain_http(origin: str) -> None:
    """Log, once per server, that an API key is sent over a network without encryption."""
    if not is_loopback(urlsplit(origin).hostname or ""):
        logger.warning(
            "%s: the API key is sent unencrypted, and others may read it; use https:// or wss://",
            origin,
        )


def tls_failure(url: str, error: ssl.SSLError) -> VLAgentsError:
    """Return the error for a failed TLS handshake, with its cure. A retry is useful only if the
    connection was lost.
    """
    if isinstance(error, (ssl.SSLEOFError, ssl.SSLZeroReturnError)):
        return ConnectionLost(
            f"{url}: the connection ended ({error}); does the server speak TLS at this port?"
        )

    if isinstance(error, ssl.SSLCertVerificationError):
        if error.verify_code in _NAME_MISMATCH_CODES:
            cure = (
                "write the URL with a host name of the certificate, or make a certificate with "
                "this host name"
            )
        else:
            cure = (
                "if your own CA signed the server's certificate, give the file of the CA's "
                "certificate, not of the server's, as ca=, or in SSL_CERT_FILE"
            )
        return ConfigError(
            f"{url}: the server's certificate is not trusted: {error.verify_message}; {cure}"
        )

    if "CERTIFICATE" in (error.reason or "") or "UNKNOWN_CA" in (error.reason or ""):
        return ConfigError(
            f"{url}: the server rejects this client's certificate, or requires one "
            f"({error.reason}); give certificate=(certificate file, key file), signed by the CA "
            "that the server trusts"
        )

    if error.reason in ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "UNSUPPORTED_PROTOCOL"):
        plain = url.replace("https://", "http://", 1).replace("wss://", "ws://", 1)
        return ConfigError(
            f"{url}: expected TLS at this port, got none ({error.reason}); if the server has "
            f"none, write {plain}"
        )
    return ConfigError(f"{url}: TLS failed ({error}); does the server speak TLS at this port?")


def require_plain(url: SplitResult, timeout_s: float) -> None:
    """Raise `ConfigError` if the URL is unencrypted but a server with TLS, whatever its
    certificate, listens at its port.
    """
    if url.scheme not in ("http", "ws"):
        return
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with socket.create_connection((url.hostname, url.port or 80), timeout_s) as connection:
            context.wrap_socket(connection, server_hostname=url.hostname).close()
    except OSError as error:
        # Only a TLS server sends an alert.
        if not isinstance(error, ssl.SSLError) or "ALERT" not in (error.reason or ""):
            return
    port = url.netloc.rpartition("@")[2]
    raise ConfigError(f"http://{port}: this port expects TLS; write https://{port}")
