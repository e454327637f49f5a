"""The comparisons of a candidate on disk: lines of JSON in files of an application, whose total size is bounded."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

logger = logging.getLogger(__name__)

_PARTS = 8  # files of a replica at most, so that the oldest eighth goes at once


class ComparisonLog:
    """Appends to `APP-REPLICA.jsonl`, `APP-REPLICA.1.jsonl` and so on, and deletes the application's oldest files.

    Args:
        folder: The folder, which is made.
        app: The application.
        replica: The replica of the candidate, which alone writes these files.
        limit: Most bytes of the application's files, but for one write.

    Raises:
        OSError: The folder cannot be made, or read.
    """

    def __init__(self, folder: Path, app: str, replica: str, limit: int) -> None:
        self._folder = folder
        self._stem = f"{app}-{replica}"
        self._own = re.compile(re.escape(app) + r"-[^-]+\.jsonl")
        self._limit = limit
        self._part = 0
        self._failed = False
        folder.mkdir(parents=True, exist_ok=True)
        self._make_room()

    def write(self, lines: Iterable[dict[str, Any]]) -> None:
        """Append lines; an error of the disk is logged, and ends the recording."""
        if self._failed:
            return
        try:
            with self._file.open("a") as file:
                file.writelines(json.dumps(line) + "\n" for line in lines)
                full = file.tell() >= self._limit // _PARTS
            if full:
                self._part += 1
                self._make_room()
        except OSError:
            logger.exception("shadow: nothing more is written to %s", self._folder)
            self._failed = True

    @property
    def _file(self) -> Path:
        return self._folder / f"{self._stem}{f'.{self._part}' if self._part else ''}.jsonl"

    def _make_room(self) -> None:
        """Delete the oldest files until another part fits in."""
        found = [(path.stat(), path) for path in self._folder.iterdir() if self._own.fullmatch(path.name)]
        total = sum(about.st_size for about, _ in found)
        for about, path in sorted(found, key=lambda one: one[0].st_mtime_ns):
            if total <= self._limit - self._limit // _PARTS:
                break
            path.unlink(missing_ok=True)
            total -= about.st_size
