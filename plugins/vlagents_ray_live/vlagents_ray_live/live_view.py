"""The data for viewers: the snapshots of a replica, as a JSON document and picture files, and those
of a fleet.

The snapshots of all replicas, and the other data of a page, are gathered once for all its viewers.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from vlagents_ray.errors import ConfigError, UnknownSession
from vlagents_ray.policies.compilation import CudaGraph
from vlagents_ray.protocol.json_messages import plain_values
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.metrics_buffer import SAMPLE, STAGES
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.periodic import each_half_second
from vlagents_ray.serve.queue.batch_queue import LoadMeter
from vlagents_ray.serve.sessions import Session
from vlagents_ray_live import live
from vlagents_ray_live.commands import TRACKED_S, CommandBoard
from vlagents_ray_live.ring import LiveConfig, Ring

logger = logging.getLogger(__name__)

_SESSIONS = 256  # maximum number of sessions that a replica's snapshot describes
_INSTRUCTION = 1000  # maximum length of an instruction
PICTURES = 2**24  # maximum size of the pictures in a snapshot; further sessions have none
_STATE_S = 0.5  # time for which data that are slow to collect are reused
# Maximum number of gathered snapshots that wait for a slow viewer; it misses the oldest.
_BEHIND = 20
_WAITING_BYTES = 2**26  # maximum size of the pictures that wait for it


@dataclass(slots=True)
class Snapshot:
    """The events of one replica since the previous snapshot."""

    number: int  # number of its last answer or observation
    document: dict[str, Any]
    files: list[bytes] = field(default_factory=list)  # files to which `document` refers by index


class ReplicaView:
    """Makes the snapshots of one replica; each viewer in another process states its last
    snapshot.
    """

    def __init__(
        self,
        engine: Engine,
        name: str,
        node: str,
        metadata: Callable[[], Mapping[str, Any]],
        settings: LiveConfig | None = None,
    ) -> None:
        """Create the view of a replica, `name` on `node`; `metadata` returns the metadata of its
        policy.

        With a folder in its `settings`, the last seconds of each session are kept from `open` on.
        """
        settings = settings or LiveConfig()
        self._engine = engine
        self._about = {
            "name": name,
            "node": node,
            "ring_s": None if settings.folder is None else settings.ring_s,
        }
        self._metadata = metadata
        self.commands = CommandBoard(engine.sessions, self._save)
        self.live = live.LiveObserver(engine.observers, self.commands)
        self.ring = None
        if settings.folder is not None:
            self.ring = Ring(self.live, engine.sessions, Path(settings.folder), settings, name)
        self._meter = LoadMeter(engine.queue)
        self._slow: dict[str, Any] = {}
        self._measured = float("-inf")
        # Number of the observation whose pictures were read last, by session.
        self._pictured: dict[str, int] = {}

    def open(self) -> None:
        """Start to end leases that viewers no longer renew."""
        each_half_second.add(self.live.expire)
        if self.ring is not None:
            self.ring.open()

    def close(self) -> None:
        """Stop keeping data."""
        if self.ring is not None:
            self.ring.close()
        each_half_second.remove(self.live.expire)
        self.live.close()

    def press(self, session: str, do: str, by: str) -> dict[str, Any] | None:
        """Give a command to a session and await its outcome for a limited time; see
        `CommandBoard.press`.

        Returns:
            The description of the command; None if the session is not at this replica.
        """
        try:
            pressed = self.commands.press(session, do, by)
        except UnknownSession:
            return None
        self.live.renew(TRACKED_S)
        return pressed

    def read(self, since: int, shown: Collection[str]) -> Snapshot:
        """Return the events since the snapshot with the number `since`, with pictures of the
        sessions `shown`.

        This may take milliseconds, too long for an event loop or the policy's thread.
        """
        engine = self._engine
        self.live.renew()
        answers = self.live.answers(since)
        snapshot = Snapshot(answers[-1].number if answers else since, {})
        last_answers = {answer.session: answer for answer in answers if answer.op in live.SHOWN_OPS}

        ids = engine.sessions.ids()
        self.live.forget_others(ids)
        self.commands.forget_others(ids)

        ordered_sessions = sorted(engine.sessions.all(), key=lambda session: session.id)
        sessions = {}
        for session in ordered_sessions[:_SESSIONS]:
            sessions[session.id] = _session(session, last_answers.get(session.id))

        # The sessions are read in the order of their pictures' age, the oldest first.
        begun = time.thread_time()
        self._pictured = {name: self._pictured.get(name, 0) for name in sessions}
        for name in sorted(sessions, key=self._pictured.__getitem__):
            observation, described = self.live.observation(name), sessions[name]
            described["commands"] = self.commands.describe(name)
            if observation is None or observation.number <= since:
                continue

            snapshot.number = max(snapshot.number, observation.number)
            described["state"] = {
                state_name: _numbers(values[: live.VALUES])
                for state_name, values in observation.state.items()
            }
            if name in shown and time.thread_time() - begun < live.ENCODING_SHARE / live.RATE:
                described["pictures"] = _pictures(observation, snapshot.files)
                if described["pictures"]:
                    self._pictured[name] = observation.number

        snapshot.document = {
            **self._about,
            **self._state(),
            **_counted(answers),
            "waiting": {
                priority.name.lower(): depth
                for priority, depth in engine.queue.depth_by_priority().items()
            },
            "sessions": list(sessions.values()),
            "sessions_held": len(engine.sessions),
        }
        return snapshot

    def _save(self, session: str) -> str:
        if self.ring is None:
            raise ConfigError(
                "save: this server keeps nothing; set `parts: {live: {folder: ...}}` in its "
                "deployment file"
            )
        return self.ring.save(session)

    def _state(self) -> dict[str, Any]:
        """Return the facts that change slowly and take long to collect."""
        engine, now = self._engine, time.monotonic()
        if now - self._measured > _STATE_S:
            metadata = self._metadata()
            self._slow = {
                "policy": metadata["policy"],
                "checkpoint": metadata["checkpoint"],
                "digest": (metadata["weights"] or {}).get("digest"),
                "weights": metadata["policy_version"],
                "devices": engine.models.devices,
                "uncompiled": engine.models.uncompiled,
                "gpu_memory": engine.models.gpu_memory(),
                "gpu_ms": engine.stats.gpu_ms,
                "replays": CudaGraph.replays,
                "ready": engine.health.ready,
                "step": engine.models.step,
                "session_limit": engine.sessions.limit,
                "utilisation": round(self._meter.read().utilisation, 3),
            }
            self._measured = now
        return self._slow


def _session(session: Session[LoadedModel], last: live.Answer | None) -> dict[str, Any]:
    """Describe a session for viewers, with its last answer if that is new."""
    weights = session.weights
    described = {
        "id": session.id,
        "transport": session.origin.transport,
        "step": session.steps - session.first,
        "instruction": session.instruction[:_INSTRUCTION],
        "silent_s": round(time.monotonic() - session.used, 2),
        "version": None if weights is None else weights.number,
        "pictures": {},
    }
    if last is None:
        return described
    return described | {"priority": last.priority, "last": _act(last)}


def _pictures(observation: live.KeptObservation, files: list[bytes]) -> dict[str, int]:
    """Add the pictures of an observation to `files`, encoding raw pixels; return their indices."""
    pictures = observation.pictures()
    if sum(map(len, files)) + sum(map(len, pictures.values())) > PICTURES:
        return {}

    first = len(files)
    files += pictures.values()
    return {camera: first + number for number, camera in enumerate(pictures)}


def _act(answer: live.Answer) -> dict[str, Any]:
    """Describe an answer for viewers."""
    ms = {name: round(value, 3) for name, value in answer.timing.items()}
    described: dict[str, Any] = {"n": answer.number, "op": answer.op, "ms": ms}
    if answer.error:
        return described | {"error": answer.error, "detail": answer.detail}

    if answer.action is not None:
        described["rows"] = answer.rows
        described["action"] = _numbers(answer.action)
        described["done"] = answer.done
        described["info"] = plain_values(answer.info)
    return described


def _numbers(values: np.ndarray) -> list[Any]:
    """Return the values, rounded to the precision that a page shows."""
    rounded: list[Any] = plain_values(np.round(values.astype(float), 4))
    return rounded


def _counted(answers: list[live.Answer]) -> dict[str, Any]:
    """Return the numbers of acts and errors among the answers, the batch sizes of the acts, and
    their times, ms.
    """
    timings = [answer.timing for answer in answers if answer.op == "act" and not answer.error]
    sample = timings[:: max(1, len(timings) // SAMPLE)]
    times_ms = {}
    for name in (*STAGES, "total"):
        times_ms[name] = [round(timing.get(f"{name}_ms", 0.0), 3) for timing in sample]

    return {
        "acts": len(timings),
        "errors": dict(Counter(answer.error for answer in answers if answer.error)),
        "batch_sizes": [int(timing.get("batch_size", 1)) for timing in sample],
        "ms": times_ms,
    }


SnapshotReader = Callable[[int, Collection[str]], Awaitable[Snapshot]]
"""Returns another replica's snapshot: since which, and the sessions whose pictures are wanted."""


class OtherReplicas(Protocol):
    """The other replicas of the application."""

    async def views(self) -> dict[str, SnapshotReader]:
        """Return the readers of the replicas' snapshots, by name."""

    async def press(self, session: str, do: str, by: str) -> dict[str, Any] | None:
        """Give a command to a session, see `CommandBoard.press`; return None if no replica has
        the session.
        """


class Viewer:
    """The unsent data of one viewer."""

    def __init__(self) -> None:
        self.shown: frozenset[str] = frozenset()  # sessions whose pictures it shows
        self._waiting: deque[list[Snapshot]] = deque()
        self._came = asyncio.Event()
        self._more: dict[str, Any] = {}  # latest data to send beside the snapshots
        self._sent = self._more

    def put(self, snapshots: list[Snapshot], more: dict[str, Any] | None = None) -> None:
        """Queue data to be sent, and drop the oldest if there are too many; `more` is sent only
        if it has changed.
        """
        self._waiting.append(snapshots)
        self._came.set()
        while len(self._waiting) > 1 and (
            len(self._waiting) > _BEHIND or self._waiting_bytes() > _WAITING_BYTES
        ):
            self._waiting.popleft()
        self._more = more or self._more

    async def next(self) -> tuple[dict[str, Any], list[bytes]]:
        """Wait for snapshots; return all waiting ones as one document, with the files to which
        it refers.
        """
        await self._came.wait()
        self._came.clear()
        gathered, self._waiting = self._waiting, deque()

        files: list[bytes] = []
        replicas = []
        for snapshots in gathered:
            for snapshot in snapshots:
                replicas.append(_with_files(snapshot, files, self.shown))

        document = {"time": time.time(), "replicas": replicas}
        if self._more is not self._sent:
            self._sent = self._more
            document |= self._more
        return document, files

    def _waiting_bytes(self) -> int:
        """Return the size of the files of the waiting snapshots."""
        size = 0
        for snapshots in self._waiting:
            for snapshot in snapshots:
                size += sum(map(len, snapshot.files))
        return size


class Fleet:
    """Gathers snapshots while there are viewers."""

    def __init__(
        self,
        own: ReplicaView | None,
        others: OtherReplicas | None = None,
        more: Callable[[], dict[str, Any]] | None = None,
    ) -> None:
        """Gather snapshots of `own`, if this process is a replica, and of the `others`.

        `more` returns further entries of the document; if nothing has changed, it returns the same
        object as before.
        """
        self._own, self._others, self._more = own, others, more
        self.viewers: set[Viewer] = set()
        self._gathering: asyncio.Task[None] | None = None
        self._read: dict[str, int] = {}  # number of the last snapshot, by replica; "" is this one

    @contextmanager
    def viewer(self) -> Iterator[Viewer]:
        """Yield a viewer, for which snapshots are gathered within the context; without viewers
        nothing is gathered.
        """
        viewer = Viewer()
        self.viewers.add(viewer)
        if self._gathering is None:
            self._gathering = asyncio.ensure_future(self._gather())
        try:
            yield viewer
        finally:
            self.viewers.discard(viewer)
            if not self.viewers:
                self._gathering.cancel()
                self._gathering = None

    async def press(self, session: str, do: str, by: str) -> dict[str, Any]:
        """Give a command to a session of any replica, and describe it, as `CommandBoard.press`
        does.
        """
        pressed = None if self._own is None else self._own.press(session, do, by)
        if pressed is None and self._others is not None:
            pressed = await self._others.press(session, do, by)
        if pressed is None:
            raise UnknownSession(f"session {session[:80]!r}: no replica has it; it has ended")
        return pressed

    async def _gather(self) -> None:
        while True:
            begun = time.monotonic()
            try:
                snapshots = await self._snapshots()
                more = None if self._more is None else await asyncio.to_thread(self._more)
            except Exception:
                logger.exception("the live view was not read; tried again")
            else:
                for viewer in self.viewers:
                    viewer.put(snapshots, more)
            await asyncio.sleep(max(1 / live.RATE / 2, 1 / live.RATE - (time.monotonic() - begun)))

    async def _snapshots(self) -> list[Snapshot]:
        shown = frozenset[str]().union(*(viewer.shown for viewer in self.viewers))
        readers: dict[str, SnapshotReader] = {}
        if self._others is not None:
            readers |= await self._others.views()
        view = self._own
        if view is not None:
            readers[""] = lambda since, shown: asyncio.to_thread(view.read, since, shown)

        results = await asyncio.gather(
            *(read(self._read.get(name, 0), shown) for name, read in readers.items()),
            return_exceptions=True,
        )
        snapshots = []
        last_numbers = {}
        for name, result in zip(readers, results, strict=True):
            if isinstance(result, Snapshot):
                snapshots.append(result)
                last_numbers[name] = result.number
            else:
                last_numbers[name] = self._read.get(name, 0)
        self._read = last_numbers

        if view is not None:
            own_result = results[-1]
            if isinstance(own_result, BaseException):
                raise own_result
        return snapshots


def _with_files(snapshot: Snapshot, files: list[bytes], shown: Collection[str]) -> dict[str, Any]:
    """Return the document of a snapshot, which refers to the collected `files`, with pictures of
    `shown` only.
    """
    sessions = []
    for session in snapshot.document["sessions"]:
        pictures: dict[str, int] = {}
        for camera, index in session["pictures"].items() if session["id"] in shown else ():
            pictures[camera] = len(files)
            files.append(snapshot.files[index])
        sessions.append(session | {"pictures": pictures})
    return snapshot.document | {"sessions": sessions}
