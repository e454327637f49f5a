"""A stand-in for Hugging Face's hub that contains no repository."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest


def empty_hub(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str | None]]:
    """Replace the hub's package; return a growing list of the requested repositories and commits."""
    asked: list[tuple[str, str | None]] = []

    def download(name: str, revision: str | None) -> str:
        asked.append((name, revision))
        raise ValueError("not here")

    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(snapshot_download=download))
    return asked
