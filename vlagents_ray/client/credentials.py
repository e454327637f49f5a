"""What a client shows to a server: its API key, and over TLS its certificate; and whom it trusts."""

from __future__ import annotations

import logging
import os
import ssl
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from vlagents_ray.errors import ConfigError, ConnectionLost, VLAgentsError

KEY_VARIABLE = "VLAGENTS_RAY_API_KEY"
WEBSOCKET_LOG = logging.getLogger("vlagents_ray.client.websocket.protocol")
"""For websockets, which at DEBUG logs the headers that it sends: all but the key."""
WEBSOCKET_LOG.addFilter(lambda record: "authorization" not in str(record.args).lower())
_Path = str | os.PathLike[str]


@dataclass(frozen=True, slots=True)
class Credentials:
    """Of one client. `certificate` is that of the client and its key; all are PEM files."""

    api_key: str | None = field(default=None, repr=False)
    ca: _Path | None = None
    certificate: tuple[_Path, _Path] | None = None

    def __post_init__(self) -> None:
        """The key comes from the environment if it is not given."""
        key = os.environ.get(KEY_VARIABLE) if self.api_key is None else self.api_key
        if key is not None and not (key.isascii() and key.isprintable() and " " not in key):
            raise ConfigError("api_key: want visible ASCII characters without spaces, as `keys new` printed them")
        object.__setattr__(self, "api_key", key or None)

    @property
    def headers(self) -> dict[str, str]:
        """Those that show the key."""
        return {} if self.api_key is None else {"authorization": f"Bearer {self.api_key}"}

    def context(self, url: str) -> ssl.SSLContext | None:
        """For a connection to that URL; None if it is not encrypted. `ConfigError` if a file is of no use."""
        if urlsplit(url).scheme not in ("https", "wss"):
            return None
        try:
            context = ssl.create_default_context(cafile=self.ca)
            if self.certificate is not None:
                context.load_cert_chain(*self.certificate)
        except OSError as error:  # ssl.SSLError is one
            raise ConfigError(
                f"TLS: ca={self.ca!r}, certificate={self.certificate!r}: not PEM files that belong together ({error})"
            ) from error
        return context


NOBODY = Credentials("")


def tls_failure(url: str, error: ssl.SSLError) -> VLAgentsError:
    """What to do about it. Another try helps only where the connection just ended."""
    if isinstance(error, (ssl.SSLEOFError, ssl.SSLZeroReturnError)):
        return ConnectionLost(f"{url}: the connection ended ({error})")
    if isinstance(error, ssl.SSLCertVerificationError):
        cure = "if the server's certificate is signed by a CA of your own, give its file as ca=, or in SSL_CERT_FILE"
        return ConfigError(f"{url}: the server's certificate is not to be trusted: {error.verify_message}; {cure}")
    if "CERTIFICATE" in (error.reason or "") or "UNKNOWN_CA" in (error.reason or ""):
        return ConfigError(
            f"{url}: the server refuses this client's certificate, or that it has none ({error.reason}); "
            f"give certificate=(certificate file, key file), signed by the CA that the server trusts"
        )
    return ConfigError(f"{url}: TLS failed ({error}); does the server speak TLS at this port?")
