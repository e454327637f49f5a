"""The certificate of a server, and the certificate authority of its clients."""

from __future__ import annotations

import os
import ssl
from dataclasses import dataclass
from pathlib import Path

from vlagents_ray.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Tls:
    """PEM files of a server; with `client_ca`, clients need a certificate signed by it (mutual TLS)."""

    certificate: Path
    key: Path
    client_ca: Path | None = None

    def check(self) -> None:
        """Raise `ConfigError` if a file is missing or not valid PEM; call it before anything starts."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            context.load_cert_chain(self.certificate, self.key, password=_refuse_passwords)
        except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
            raise ConfigError(
                f"TLS: {self.certificate} and {self.key} are no certificate and its key without a password, "
                f"both in PEM ({error})"
            ) from error
        try:
            if self.client_ca is not None:
                context.load_verify_locations(self.client_ca)
        except OSError as error:
            raise ConfigError(f"TLS: {self.client_ca} holds no certificates in PEM ({error})") from error

    def bundle(self, folder: Path) -> Path:
        """Write certificate and key into one file for HAProxy, readable by its owner alone, in a private `folder`."""
        file = folder / "tls.pem"
        with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as written:
            written.write(self.certificate.read_bytes().rstrip() + b"\n" + self.key.read_bytes())
        return file


def _refuse_passwords() -> bytes:
    """Refuse a key with a password, for which OpenSSL would otherwise prompt on the terminal."""
    raise ValueError("the key has a password")
