"""Which checkpoints of a training run that goes on are there, whole, and new."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePath

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.checkpoint import STEP, at_step
from vlagents_ray.policies.base.whole import unfinished

FINISHED = "training_finished"  # a file of this name in the folder says that no checkpoint follows
PADDED = 6  # digits to which a step may be filled up with zeros, as `find_checkpoint` takes it

Snapshot = frozenset[tuple[str, int, int]]  # (path, size in bytes, time of change in ns) of each file


@dataclass(slots=True)
class _Seen:
    """A step that is not known to be whole yet."""

    entry: Path  # in the folder that is watched
    checkpoint: Path  # what the policy loads: the entry, or something in it
    snapshot: Snapshot
    since: float  # s, when it was first seen as it is
    why: str = ""  # it does not count yet


class Watcher:
    """Looks at a folder, again and again."""

    def __init__(self, pattern: str, folder: Path | None = None, *, settle_s: float = 10.0, marker: str | None = None):
        """`pattern` is a checkpoint's path with `{step}` in it; steps are looked for in `folder`, or where it says.

        A checkpoint is whole when nothing of `vlagents_ray.policies.base.whole` speaks against it, and either it has
        not changed for `settle_s` seconds (names, sizes, times), or it holds a file called `marker`, if its trainer
        writes one when it is done.
        """
        parts = PurePath(pattern).parts
        place = next((i for i, part in enumerate(parts) if STEP in part), None)
        if place is None:
            raise ConfigError(f"checkpoint {pattern!r}: has no {STEP} in it; write one where the step stands")
        self.folder = Path(*parts[:place]) if folder is None else folder
        self._below = parts[place + 1 :]
        self._name = re.compile(re.escape(parts[place]).replace(re.escape(STEP), r"(\d+)", 1))
        self._settle_s = settle_s
        self._marker = marker
        self._seen: dict[int, _Seen] = {}
        self._whole: set[int] = set()

    def look(self, now: float) -> list[int]:
        """The steps that have turned out to be whole since the last look, ascending; `now` in s of any clock."""
        found = self._found()
        for step in self._seen.keys() - found.keys():
            del self._seen[step]
        new = [
            step for step, entry in sorted(found.items()) if step not in self._whole and self._ready(step, entry, now)
        ]
        self._whole.update(new)
        for step in new:
            del self._seen[step]
        return new

    @property
    def finished(self) -> bool:
        """Has the training said that no checkpoint follows?"""
        return (self.folder / FINISHED).exists()

    def still(self, now: float) -> bool:
        """Has nothing of what is not whole changed for as long as a checkpoint takes to count?"""
        return all(now - seen.since >= self._settle_s for seen in self._seen.values())

    def waiting(self) -> dict[int, str]:
        """Steps that do not count as whole, and why."""
        return {step: seen.why for step, seen in sorted(self._seen.items())}

    def _found(self) -> dict[int, Path]:
        if not self.folder.is_dir():
            return {}
        matches = [(self._name.fullmatch(entry.name), entry) for entry in self.folder.iterdir()]
        found = {
            int(match[1]): entry for match, entry in matches if match and match[1] == f"{int(match[1]):0{PADDED}d}"
        }
        return found | {int(m[1]): entry for m, entry in matches if m and m[1] == str(int(m[1]))}

    def _ready(self, step: int, entry: Path, now: float) -> bool:
        snapshot = _snapshot(entry)
        seen = self._seen.get(step)
        if seen is None or seen.snapshot != snapshot:
            digits = (self._name.fullmatch(entry.name) or [""] * 2)[1]
            below = [at_step(part, digits) for part in self._below]
            seen = self._seen[step] = _Seen(entry, entry.joinpath(*below), snapshot, now)
        if self._marker is not None:
            seen.why = "" if (entry / self._marker).exists() else f"has no {self._marker}"
        else:
            seen.why = "" if now - seen.since >= self._settle_s else "is too new, or changes"
        if not seen.why:
            # Looked at last, and compared again: what passes is what stood still.
            seen.why = unfinished(seen.checkpoint) or ("" if _snapshot(entry) == snapshot else "changes")
        return not seen.why


def rounds(
    watcher: Watcher, until: int | None, pause: Callable[[], object], clock: Callable[[], float] = time.monotonic
) -> Iterator[list[int]]:
    """The steps that have become whole, together, those after `until` left out; `pause` is called between two looks.

    Ends when a whole step is `until` or later, or when the training has said that it is finished.
    """
    while True:
        now, finished = clock(), watcher.finished  # before the look, which then sees all that there will be
        steps = watcher.look(now)
        if wanted := [step for step in steps if until is None or step <= until]:
            yield wanted
        if until is not None and any(step >= until for step in steps):
            return
        if finished and not steps and watcher.still(now):
            return
        pause()


def _snapshot(entry: Path) -> Snapshot:
    if not entry.is_dir():
        return frozenset(_line(entry))
    names = [Path(folder, name) for folder, _, files in os.walk(entry) for name in files]
    return frozenset(line for path in names for line in _line(path))


def _line(path: Path) -> Iterator[tuple[str, int, int]]:
    try:
        found = path.stat()
    except FileNotFoundError:  # renamed meanwhile
        return
    yield str(path), found.st_size, found.st_mtime_ns
