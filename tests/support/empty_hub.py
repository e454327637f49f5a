"""Hugging Face's hub, as a stand-in that has no repository."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest


def empty_hub(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str | None]]:
    """Replace the hub's package; return the repositories and commits that are asked for, as they
    come.
    """
    asked: list[tuple[str, str | None]] = []

    def download(name: str, revision: str | None) -> str:
        asked.append((name, revision))
        raise ValueError("not here")

    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(snapshot_download=download))
    return asked
