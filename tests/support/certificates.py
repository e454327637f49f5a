"""A private certificate authority for tests, made with openssl."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Authority:
    """A certificate authority that writes signed certificates to its folder."""

    folder: Path
    name: str

    @property
    def file(self) -> Path:
        """Path of the authority's own certificate."""
        return self.folder / f"{self.name}.pem"

    def sign(self, whom: str, addresses: str = "IP:127.0.0.1") -> tuple[Path, Path]:
        """Return the paths of a new certificate and of its key."""
        certificate, key = (
            self.folder / f"{self.name}-{whom}.pem",
            self.folder / f"{self.name}-{whom}.key",
        )
        request, extensions = certificate.with_suffix(".csr"), certificate.with_suffix(".ext")
        extensions.write_text(f"subjectAltName={addresses}\n")
        _openssl(
            "req",
            "-newkey",
            *_CURVE,
            "-nodes",
            "-subj",
            f"/CN={whom}",
            "-keyout",
            key,
            "-out",
            request,
        )
        _openssl(
            "x509",
            "-req",
            "-in",
            request,
            "-CA",
            self.file,
            "-CAkey",
            self.file.with_suffix(".key"),
            "-CAcreateserial",
            "-days",
            "2",
            "-extfile",
            extensions,
            "-out",
            certificate,
        )
        return certificate, key


_CURVE = ("ec", "-pkeyopt", "ec_paramgen_curve:prime256v1")


def authority(folder: Path, name: str) -> Authority:
    """Return a new certificate authority."""
    made = Authority(folder, name)
    key = made.file.with_suffix(".key")
    _openssl(
        "req", "-x509", "-newkey", *_CURVE, "-nodes", "-days", "2", "-subj", f"/CN={name}",
        "-addext", "keyUsage=critical,keyCertSign,cRLSign", "-keyout", key, "-out", made.file,
    )  # fmt: skip
    return made


def _openssl(*words: str | Path) -> None:
    subprocess.run(["openssl", *map(str, words)], check=True, capture_output=True, timeout=30)
