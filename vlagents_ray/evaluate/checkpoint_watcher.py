"""Finds the new checkpoints of a running training when they are complete."""

from __future__ import annotations

import contextlib
import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePath

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.checkpoint import STEP, at_step
from vlagents_ray.policies.base.checkpoint_files import unfinished

FINISHED = "training_finished"  # a file of this name in the folder means that no checkpoint follows

# (path, size in bytes, time of change in ns) of each file.
Snapshot = frozenset[tuple[str, int, int]]


@dataclass(slots=True)
class _SeenFile:
    """The state of a checkpoint since its last change, until it is complete."""

    snapshot: Snapshot
    since: float  # s, when this state was first seen
    why: str = ""  # the reason why it is not complete
    examined: bool = False  # whether its files were examined since they changed


class CheckpointWatcher:
    """Polls a folder for checkpoints."""

    def __init__(
        self,
        pattern: str,
        folder: Path | None = None,
        *,
        settle_s: float = 10.0,
        marker: str | None = None,
    ):
        """Watch for checkpoints.

        A checkpoint is complete when `vlagents_ray.policies.base.checkpoint_files` finds no fault
        in it, and either its names, sizes and times have not changed for `settle_s` seconds, or it
        holds a file called `marker`.

        Args:
            pattern: A checkpoint's path with `{step}` in it.
            folder: The folder of the steps; by default the part of `pattern` before `{step}`.
            settle_s: Seconds without a change.
            marker: The name of a file that the trainer writes last, if it does.
        """
        parts = PurePath(pattern).parts
        if (place := next((i for i, part in enumerate(parts) if STEP in part), None)) is None:
            raise ConfigError(
                f"checkpoint {pattern!r}: has no {STEP} in it; write one where the step stands"
            )
        self.folder = Path(*parts[:place]) if folder is None else folder
        self._below = parts[place + 1 :]
        self._name = re.compile(re.escape(parts[place]).replace(re.escape(STEP), r"(\d+)", 1))
        self._settle_s, self._marker = settle_s, marker
        self._seen: dict[int, _SeenFile] = {}
        self._complete: set[int] = set()

    def scan(self, now: float) -> list[int]:
        """Return the steps completed since the last call, ascending; `now` is in s, of any
        clock.
        """
        found = self._found()
        self._seen = {step: seen for step, seen in self._seen.items() if step in found}
        new = [
            step
            for step in sorted(found.keys() - self._complete)
            if self._is_complete(step, found[step], now)
        ]
        self._complete.update(new)
        for step in new:
            del self._seen[step]
        return new

    @property
    def finished(self) -> bool:
        """Whether the training has announced that no checkpoint follows."""
        return (self.folder / FINISHED).exists()

    def is_settled(self, now: float) -> bool:
        """Return whether no unfinished checkpoint has changed for `settle_s` seconds."""
        return all(now - seen.since >= self._settle_s for seen in self._seen.values())

    def waiting(self) -> dict[int, str]:
        """Return the steps that are not complete, each with the reason."""
        return {step: seen.why for step, seen in sorted(self._seen.items())}

    def _found(self) -> dict[int, tuple[Path, Path]]:
        """Return by step the entry of the folder, and the path that the policy loads: the entry,
        or one in it.
        """
        found: dict[int, tuple[Path, Path]] = {}
        for entry in self.folder.iterdir() if self.folder.is_dir() else ():
            match = self._name.fullmatch(entry.name)
            step = int(match[1]) if match else -1
            # As `find_checkpoint` accepts it.
            if match is None or match[1] not in (str(step), f"{step:06d}"):
                continue
            if step not in found or match[1] == str(step):  # the policy looks for this name first
                found[step] = (
                    entry,
                    entry.joinpath(*(at_step(part, match[1]) for part in self._below)),
                )
        return found

    def _is_complete(self, step: int, found: tuple[Path, Path], now: float) -> bool:
        entry, checkpoint = found
        snapshot = _snapshot(entry)
        seen = self._seen.get(step)
        if seen is None or seen.snapshot != snapshot:
            seen = self._seen[step] = _SeenFile(snapshot, now)
        if seen.examined:
            return False
        if self._marker is not None:
            seen.why = "" if (entry / self._marker).exists() else f"has no {self._marker}"
        else:
            seen.why = "" if now - seen.since >= self._settle_s else "is too new, or changes"
        if seen.why:
            return False
        seen.why, seen.examined = unfinished(checkpoint) or "", True
        return not seen.why and _snapshot(entry) == snapshot  # it passed, and has not changed since


def rounds(
    watcher: CheckpointWatcher,
    until: int | None,
    pause: Callable[[], object],
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[list[int]]:
    """Yield the completed steps up to `until`; `pause` is called between two scans of the folder.

    It ends when a step at or after `until` is complete, or when the training has announced its end.
    """
    while True:
        # Read before the scan, which then finds all checkpoints.
        now, finished = clock(), watcher.finished
        steps = watcher.scan(now)
        if wanted := [step for step in steps if until is None or step <= until]:
            yield wanted
        if until is not None and any(step >= until for step in steps):
            return
        if finished and not steps and watcher.is_settled(now):
            return
        pause()


def _snapshot(entry: Path) -> Snapshot:
    names = [Path(folder, name) for folder, _, files in os.walk(entry) for name in files]
    found = set()
    for path in names if entry.is_dir() else [entry]:
        with contextlib.suppress(FileNotFoundError):  # it has been renamed
            state = path.stat()
            found.add((str(path), state.st_size, state.st_mtime_ns))
    return frozenset(found)
