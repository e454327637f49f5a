"""Detects when new checkpoints of a running training are complete."""

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

FINISHED = "training_finished"  # name of the file that announces the end of the training

# Path, size in bytes and modification time in ns of each file.
Snapshot = frozenset[tuple[str, int, int]]


@dataclass(slots=True)
class _IncompleteCheckpoint:
    """An incomplete checkpoint since its last change."""

    snapshot: Snapshot
    since: float  # time at which this snapshot was first taken, s
    why: str = ""  # the reason why the checkpoint is incomplete
    examined: bool = False  # whether the files were checked since their last change


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
        in it, and either the names, sizes and times of its files have not changed for `settle_s`
        seconds, or it contains a file named `marker`.

        Args:
            pattern: A checkpoint's path with `{step}` in it.
            folder: The folder of the steps; by default the part of `pattern` before `{step}`.
            settle_s: The required time without a change, s.
            marker: The name of the file that the trainer writes last, if there is one.
        """
        names = PurePath(pattern).parts
        step_index = next((i for i, name in enumerate(names) if STEP in name), None)
        if step_index is None:
            raise ConfigError(
                f"checkpoint {pattern!r}: expected {STEP} in the pattern, got none; write it in "
                f"place of the step's number"
            )

        self.folder = Path(*names[:step_index]) if folder is None else folder
        self._below = names[step_index + 1 :]
        step_name = re.escape(names[step_index])
        self._name = re.compile(step_name.replace(re.escape(STEP), r"(\d+)", 1))
        self._settle_s = settle_s
        self._marker = marker
        self._incomplete: dict[int, _IncompleteCheckpoint] = {}
        self._complete: set[int] = set()

    def scan(self, now: float) -> list[int]:
        """Return the steps of the checkpoints that were completed since the last call, in ascending
        order.

        Args:
            now: The time of any monotonic clock, s.
        """
        paths_by_step = self._paths_by_step()
        for step in self._incomplete.keys() - paths_by_step.keys():
            del self._incomplete[step]

        completed_steps = []
        for step in sorted(paths_by_step.keys() - self._complete):
            entry, checkpoint = paths_by_step[step]
            if self._is_complete(step, entry, checkpoint, now):
                completed_steps.append(step)

        self._complete.update(completed_steps)
        for step in completed_steps:
            del self._incomplete[step]
        return completed_steps

    @property
    def finished(self) -> bool:
        """Whether the training has announced that it writes no further checkpoint."""
        return (self.folder / FINISHED).exists()

    def is_settled(self, now: float) -> bool:
        """Return whether no unfinished checkpoint has changed for `settle_s` seconds."""
        checkpoints = self._incomplete.values()
        return all(now - checkpoint.since >= self._settle_s for checkpoint in checkpoints)

    def waiting(self) -> dict[int, str]:
        """Return the steps of the incomplete checkpoints, each with the reason."""
        return {step: checkpoint.why for step, checkpoint in sorted(self._incomplete.items())}

    def _paths_by_step(self) -> dict[int, tuple[Path, Path]]:
        """Return two paths for each step: the entry of the folder, and the path that the policy
        loads, which is the entry or is below it.
        """
        paths: dict[int, tuple[Path, Path]] = {}
        for entry in self.folder.iterdir() if self.folder.is_dir() else ():
            match = self._name.fullmatch(entry.name)
            step = int(match[1]) if match else -1
            # `find_checkpoint` accepts only these two forms of a step.
            if match is None or match[1] not in (str(step), f"{step:06d}"):
                continue
            # The policy searches for this name first.
            if step not in paths or match[1] == str(step):
                names_below = [at_step(name, match[1]) for name in self._below]
                paths[step] = (entry, entry.joinpath(*names_below))
        return paths

    def _is_complete(self, step: int, entry: Path, checkpoint: Path, now: float) -> bool:
        snapshot = _snapshot(entry)
        state = self._incomplete.get(step)
        if state is None or state.snapshot != snapshot:
            state = self._incomplete[step] = _IncompleteCheckpoint(snapshot, now)
        if state.examined:
            return False

        if self._marker is not None:
            state.why = "" if (entry / self._marker).exists() else f"has no {self._marker}"
        else:
            settled = now - state.since >= self._settle_s
            state.why = "" if settled else f"changed less than {self._settle_s:g} s ago"
        if state.why:
            return False

        state.why = unfinished(checkpoint) or ""
        state.examined = True
        # The files have no fault, but they may have changed during the check.
        return not state.why and _snapshot(entry) == snapshot


def rounds(
    watcher: CheckpointWatcher,
    until: int | None,
    pause: Callable[[], object],
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[list[int]]:
    """Yield the completed steps up to `until`. End when a step at or after `until` is complete, or
    when the training has announced its end.

    Args:
        watcher: Detects the checkpoints.
        until: The last step to evaluate; None for all steps.
        pause: Called between two scans of the folder.
        clock: Returns the time, s.
    """
    while True:
        # Read the announcement before the scan, so that the scan finds all checkpoints.
        now, finished = clock(), watcher.finished
        steps = watcher.scan(now)
        steps_to_evaluate = [step for step in steps if until is None or step <= until]
        if steps_to_evaluate:
            yield steps_to_evaluate

        if until is not None and any(step >= until for step in steps):
            return
        if finished and not steps and watcher.is_settled(now):
            return
        pause()


def _snapshot(entry: Path) -> Snapshot:
    """Return the paths, sizes and times of a checkpoint's files."""
    if entry.is_dir():
        paths = []
        for folder, _, names in os.walk(entry):
            paths += [Path(folder, name) for name in names]
    else:
        paths = [entry]

    files = set()
    for path in paths:
        with contextlib.suppress(FileNotFoundError):  # the file was renamed meanwhile
            state = path.stat()
            files.add((str(path), state.st_size, state.st_mtime_ns))
    return frozenset(files)
