"""Several watchers of an engine's messages, of which a message knows one at most."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from vlagents_ray.images.codecs import DecodedFiles
    from vlagents_ray.protocol.messages import Reply, Request
    from vlagents_ray.serve.engine.responses import Done, Watcher

_lock = threading.Lock()


class Watched(Protocol):
    """An engine: `vlagents_ray.serve.engine.engine.Engine`."""

    live: Watcher | None


@dataclass(frozen=True, slots=True)
class _Several:
    parts: tuple[Watcher, ...]

    def note(self, sessions: Sequence[str], items: Sequence[Request | Reply], files: DecodedFiles, done: Done) -> Done:
        for part in self.parts:
            done = part.note(sessions, items, files, done)
        return done


def watch(engine: Watched, watcher: Watcher) -> None:
    """Let `watcher` see the messages of `engine` from now on, besides those that do already."""
    with _lock:
        _set(engine, (*_parts(engine), watcher))


def unwatch(engine: Watched, watcher: Watcher) -> None:
    """End that; does nothing if `watcher` does not watch."""
    with _lock:
        _set(engine, tuple(part for part in _parts(engine) if part is not watcher))


def _parts(engine: Watched) -> tuple[Watcher, ...]:
    if isinstance(engine.live, _Several):
        return engine.live.parts
    return () if engine.live is None else (engine.live,)


def _set(engine: Watched, parts: tuple[Watcher, ...]) -> None:
    engine.live = None if not parts else parts[0] if len(parts) == 1 else _Several(parts)
