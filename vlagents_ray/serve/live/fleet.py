"""The snapshots of all replicas, and what is shown beside them, gathered once for all viewers of one page."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable, Collection
from contextlib import suppress
from functools import partial
from typing import Any, Protocol

from vlagents_ray.errors import UnknownSession
from vlagents_ray.serve.live.snapshot import ReplicaView, Snapshot
from vlagents_ray.serve.live.tap import RATE

logger = logging.getLogger(__name__)

_BEHIND = 20  # most gathered snapshots that wait for a slow viewer; it misses the oldest
_WAITING_BYTES = 2**26  # most bytes of pictures that wait for it

Other = Callable[[int, Collection[str]], Awaitable[Snapshot]]
"""Returns another replica's snapshot: since which, and the sessions whose pictures are wanted."""

Beside = Callable[[], dict[str, Any]]
"""Returns further entries of the document; the same object as before if nothing in them has changed."""


class OtherReplicas(Protocol):
    """The other replicas of the application."""

    async def views(self) -> dict[str, Other]:
        """Return the reader of the snapshots of each, by name."""
        ...

    async def press(self, session: str, do: str, by: str) -> dict[str, Any] | None:
        """Give a command to a session of one of them, see `CommandBoard.press`; None if none has the session."""
        ...


class Viewer:
    """What one viewer is still to be sent."""

    def __init__(self) -> None:
        self.shown: frozenset[str] = frozenset()  # the sessions whose pictures it shows
        self._waiting: deque[list[Snapshot]] = deque()
        self._came = asyncio.Event()
        self._beside: dict[str, Any] = {}  # what was last to be sent beside the snapshots
        self._sent = self._beside

    def put(self, snapshots: list[Snapshot], beside: dict[str, Any] | None = None) -> None:
        """Add what is to be sent, and drop the oldest of too much; `beside` is sent if it is another than before."""
        self._waiting.append(snapshots)
        self._came.set()
        while len(self._waiting) > 1 and (len(self._waiting) > _BEHIND or self.waiting_bytes > _WAITING_BYTES):
            self._waiting.popleft()
        self._beside = beside or self._beside

    @property
    def waiting_bytes(self) -> int:
        """The bytes of the pictures that wait."""
        return sum(len(file) for snapshots in self._waiting for one in snapshots for file in one.files)

    async def next(self) -> tuple[dict[str, Any], list[bytes]]:
        """Wait for snapshots; return all that wait as one document and the files that it refers to."""
        await self._came.wait()
        self._came.clear()
        gathered, self._waiting = self._waiting, deque()
        files: list[bytes] = []
        replicas = [_with_files(one, files, self.shown) for snapshots in gathered for one in snapshots]
        document = {"time": time.time(), "replicas": replicas}
        if self._beside is not self._sent:
            self._sent = self._beside
            document |= self._beside
        return document, files


class Fleet:
    """Gathers while there are viewers."""

    def __init__(
        self, own: ReplicaView | None, others: OtherReplicas | None = None, beside: Beside | None = None
    ) -> None:
        """Gather the snapshots of `own`, if this process is a replica, and of the `others`, and what is `beside`."""
        self._own = own
        self._others = others
        self._beside = beside
        self._viewers: set[Viewer] = set()
        self._gathering: asyncio.Task[None] | None = None
        self._read: dict[str, int] = {}  # number of the last snapshot, by replica; "" is the own one

    @property
    def watched(self) -> bool:
        """Whether there are viewers."""
        return bool(self._viewers)

    def add(self) -> Viewer:
        """Begin to gather for a new viewer."""
        viewer = Viewer()
        self._viewers.add(viewer)
        if self._gathering is None:
            self._gathering = asyncio.ensure_future(self._gather())
        return viewer

    def remove(self, viewer: Viewer) -> None:
        """Stop to gather for a viewer."""
        self._viewers.discard(viewer)
        if not self._viewers and self._gathering is not None:
            self._gathering.cancel()
            self._gathering = None

    async def press(self, session: str, do: str, by: str) -> dict[str, Any]:
        """Give a command to a session of any replica, see `CommandBoard.press`, and return it."""
        if self._own is not None:
            with suppress(UnknownSession):
                return self._own.commands.press(session, do, by)
        pressed = None if self._others is None else await self._others.press(session, do, by)
        if pressed is None:
            raise UnknownSession(f"session {session[:80]!r}: no replica has it; it has ended")
        return pressed

    async def _gather(self) -> None:
        while True:
            begun = time.monotonic()
            try:
                snapshots = await self._snapshots()
                beside = None if self._beside is None else await asyncio.to_thread(self._beside)
            except Exception:
                logger.exception("the live view was not read; tried again")
            else:
                for viewer in self._viewers:
                    viewer.put(snapshots, beside)
            await asyncio.sleep(max(1 / RATE / 2, 1 / RATE - (time.monotonic() - begun)))

    async def _snapshots(self) -> list[Snapshot]:
        shown = frozenset[str]().union(*(viewer.shown for viewer in self._viewers))
        readers: dict[str, Other] = {} if self._others is None else dict(await self._others.views())
        if self._own is not None:
            readers[""] = partial(_read_own, self._own)
        results = await asyncio.gather(
            *(read(self._read.get(name, 0), shown) for name, read in readers.items()), return_exceptions=True
        )
        found = {name: one for name, one in zip(readers, results, strict=True) if isinstance(one, Snapshot)}
        self._read = {name: one.number for name, one in found.items()} | {
            name: number for name, number in self._read.items() if name in readers and name not in found
        }
        if self._own is not None and isinstance(error := results[-1], BaseException):
            raise error
        return list(found.values())


async def _read_own(own: ReplicaView, since: int, shown: Collection[str]) -> Snapshot:
    return await asyncio.to_thread(own.read, since, shown)


def _with_files(snapshot: Snapshot, files: list[bytes], shown: Collection[str]) -> dict[str, Any]:
    """Return the document of a snapshot, whose references lead into `files`, with pictures of `shown` alone."""
    sessions = []
    for session in snapshot.document["sessions"]:
        pictures: dict[str, int] = {}
        for camera, index in session["pictures"].items() if session["id"] in shown else ():
            pictures[camera] = len(files)
            files.append(snapshot.files[index])
        sessions.append(session | {"pictures": pictures})
    return snapshot.document | {"sessions": sessions}
