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


@dataclass(frozen=True, slots=True)
class _Found:
    """A step in the folder."""

    entry: Path  # in the folder itself
    checkpoint: Path  # what the policy loads: the entry, or something in it


@dataclass(slots=True)
class _Seen:
    """A step that is not known to be whole yet, as it was when it last changed."""

    snapshot: Snapshot
    since: float  # s, when it was first seen so
    why: str = ""  # it does not count yet
    judged: bool = False  # by its files, which say the same until they change


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
        self._seen = {step: seen for step, seen in self._seen.items() if step in found}
        new = [step for step in sorted(found.keys() - self._whole) if self._is_whole(step, found[step], now)]
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

    def _found(self) -> dict[int, _Found]:
        found: dict[int, _Found] = {}
        for entry in self.folder.iterdir() if self.folder.is_dir() else ():
            match = self._name.fullmatch(entry.name)
            step = int(match[1]) if match else -1
            if match is None or match[1] not in (str(step), f"{step:0{PADDED}d}"):
                continue
            if step not in found or match[1] == str(step):  # which is looked for first
                found[step] = _Found(entry, entry.joinpath(*(at_step(part, match[1]) for part in self._below)))
        return found

    def _is_whole(self, step: int, found: _Found, now: float) -> bool:
        snapshot = _snapshot(found.entry)
        seen = self._seen.get(step)
        if seen is None or seen.snapshot != snapshot:
            seen = self._seen[step] = _Seen(snapshot, now)
        if seen.judged:
            return False
        if self._marker is not None:
            seen.why = "" if (found.entry / self._marker).exists() else f"has no {self._marker}"
        else:
            seen.why = "" if now - seen.since >= self._settle_s else "is too new, or changes"
        if seen.why:
            return False
        seen.why, seen.judged = unfinished(found.checkpoint) or "", True
        return not seen.why and _snapshot(found.entry) == snapshot  # what passes stood still while it was looked at


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
