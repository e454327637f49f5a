"""The data for viewers: the snapshots of a replica, as a JSON document and picture files, and the
snapshots of all replicas.

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
from vlagents_ray.protocol.json_messages import plain_values
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.metrics_buffer import SAMPLE, STAGES
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.periodic import each_half_second
from vlagents_ray.serve.queue.batch_queue import LoadMeter
from vlagents_ray.serve.sessions import Session
from vlagents_ray_live import live
from vlagents_ray_live.commands import TRACKED_S, CommandBoard, episode_of
from vlagents_ray_live.ring import LiveConfig, Ring

logger = logging.getLogger(__name__)

_SESSIONS = 256  # maximum number of sessions that a replica's snapshot describes
_INSTRUCTION = 1000  # maximum length of an instruction
# Maximum size of the pictures in a snapshot, bytes; further sessions have no pictures.
PICTURES = 2**24
_STATE_S = 0.5  # the time for which data that are slow to collect are reused
# Maximum number of gathered snapshots that wait for a slow viewer; beyond it, the oldest are
# dropped.
_BEHIND = 20
_WAITING_BYTES = 2**26  # maximum size of the pictures that wait for a slow viewer, bytes


@dataclass(slots=True)
class Snapshot:
    """The events of one replica since the previous snapshot."""

    number: int  # the number of the last answer or observation in the snapshot
    document: dict[str, Any]
    # The picture files, to which `document` refers by index.
    files: list[bytes] = field(default_factory=list)


class ReplicaView:
    """Makes the snapshots of one replica.

    Args:
        engine: The engine of the replica.
        name: The name of the replica.
        node: The node on which it runs.
        metadata: Returns the metadata of its policy.
        settings: The settings of the live page. With a folder, the last seconds of each session are
            kept, beginning with `open`.
    """

    def __init__(
        self,
        engine: Engine,
        name: str,
        node: str,
        metadata: Callable[[], Mapping[str, Any]],
        settings: LiveConfig | None = None,
    ) -> None:
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
        self._slow_data: dict[str, Any] = {}
        self._collected_at = float("-inf")
        # The number of the observation whose pictures were read last, by session.
        self._pictured: dict[str, int] = {}

    def open(self) -> None:
        """Start to drop data that viewers no longer read."""
        each_half_second.add(self.live.expire)
        if self.ring is not None:
            self.ring.open()

    def close(self) -> None:
        """Stop keeping data."""
        if self.ring is not None:
            self.ring.close()
        each_half_second.remove(self.live.expire)
        self.live.close()

    def press(
        self, session: str, do: str, by: str, episode: str | None = None
    ) -> dict[str, Any] | None:
        """Give a command to a session, and wait for its outcome for a limited time.

        Args:
            session: The session.
            do: The command, see `CommandBoard.press`.
            by: The name of the caller's key.
            episode: The episode of a mark, see `CommandBoard.press`.

        Returns:
            The description of the command; None if the session is not at this replica.
        """
        try:
            pressed = self.commands.press(session, do, by, episode)
        except UnknownSession:
            return None
        self.live.renew(TRACKED_S)
        return pressed

    def read(self, since: int, shown: Collection[str]) -> Snapshot:
        """Make a snapshot.

        This may take milliseconds, too long for an event loop or the policy's thread.

        Args:
            since: The number of the viewer's last snapshot; 0 for the first one.
            shown: The sessions whose pictures are requested.

        Returns:
            The events since the last snapshot.
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
            sessions[session.id] = _session(session, last_answers.get(session.id), engine.clock())

        # The sessions whose pictures are the oldest come first.
        begun = time.thread_time()
        self._pictured = {name: self._pictured.get(name, 0) for name in sessions}
        for name in sorted(sessions, key=self._pictured.__getitem__):
            observation = self.live.observation(name)
            described = sessions[name]
            described["commands"] = self.commands.describe(name)
            if observation is None or observation.number <= since:
                continue

            snapshot.number = max(snapshot.number, observation.number)
            state = {}
            for state_name, values in observation.state.items():
                state[state_name] = _numbers(values[: live.VALUES])
            described["state"] = state

            if name in shown and time.thread_time() - begun < live.ENCODING_SHARE / live.RATE:
                described["pictures"] = _pictures(observation, snapshot.files)
                if described["pictures"]:
                    self._pictured[name] = observation.number

        waiting = {}
        for priority, depth in engine.queue.depth_by_priority().items():
            waiting[priority.name.lower()] = depth
        snapshot.document = {
            **self._about,
            **self._state(),
            **_counts(answers),
            "waiting": waiting,
            "sessions": list(sessions.values()),
            "sessions_held": len(engine.sessions),
        }
        return snapshot

    async def read_on_thread(self, since: int, shown: Collection[str]) -> Snapshot:
        """Make a snapshot on another thread, see `read`."""
        return await asyncio.to_thread(self.read, since, shown)

    def _save(self, session: str) -> str:
        """Save the last seconds of a session, and return the path of the dataset."""
        if self.ring is None:
            raise ConfigError(
                "save: this server keeps nothing; set `parts: {live: {folder: ...}}` in its "
                "deployment file"
            )
        return self.ring.save(session)

    def _state(self) -> dict[str, Any]:
        """Return the data that change slowly and take long to collect."""
        engine = self._engine
        now = time.monotonic()
        if now - self._collected_at > _STATE_S:
            metadata = self._metadata()
            self._slow_data = {
                "policy": metadata["policy"],
                "checkpoint": metadata["checkpoint"],
                "digest": (metadata["weights"] or {}).get("digest"),
                "weights": metadata["policy_version"],
                "devices": engine.model.devices,
                "uncompiled": engine.model.uncompiled,
                "gpu_memory": engine.model.gpu_memory(),
                "gpu_ms": engine.stats.gpu_ms,
                "replays": engine.stats.replays,
                "ready": engine.health.ready,
                "step": engine.model.step,
                "session_limit": engine.sessions.limit,
                "utilisation": round(self._meter.read().utilisation, 3),
            }
            self._collected_at = now
        return self._slow_data


def _session(session: Session[LoadedModel], last: live.Answer | None, now: float) -> dict[str, Any]:
    """Describe a session for viewers at `now`, s, of the engine's clock; include the session's last
    answer if it is new.
    """
    weights = session.weights
    described = {
        "id": session.id,
        "transport": session.origin.transport,
        "step": session.steps - session.first,
        "episode": episode_of(session),
        "instruction": session.instruction[:_INSTRUCTION],
        "silent_s": round(time.monotonic() - session.used, 2),
        "version": None if weights is None else weights.number,
        "in_time": _in_time(session, now),
        "pictures": {},
    }
    if last is None:
        return described
    return described | {"priority": last.priority, "last": _act(last)}


def _in_time(session: Session[LoadedModel], now: float) -> dict[str, Any] | None:
    """Describe how well a session's robot was served lately; None if the robot does not report
    this.
    """
    if session.times is None:
        return None
    lately = session.times.lately(now)
    if lately.share is None:
        return None
    age_ms = lately.age_p95_ms
    within_tolerance = session.times.within_tolerance(now)
    return {
        "share": round(lately.share, 4),
        "age_p95_ms": None if age_ms is None else round(age_ms, 1),
        "within_tolerance": None if within_tolerance is None else round(within_tolerance, 4),
    }


def _pictures(observation: live.KeptObservation, files: list[bytes]) -> dict[str, int]:
    """Add the pictures of an observation to `files`, encoding raw pixels; return their indices."""
    pictures = observation.pictures()
    if sum(map(len, files)) + sum(map(len, pictures.values())) > PICTURES:
        return {}

    indices = {}
    for camera, file in pictures.items():
        indices[camera] = len(files)
        files.append(file)
    return indices


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


def _counts(answers: list[live.Answer]) -> dict[str, Any]:
    """Count the actions and the errors among answers.

    Returns:
        The number of answers with an action, the number of each error, and the batch sizes and
        times (ms by stage) of a sample of the actions.
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
"""A function that returns another replica's snapshot. Its arguments are the number of the last
snapshot, and the sessions whose pictures are requested.
"""


class OtherReplicas(Protocol):
    """The other replicas of the application."""

    async def views(self) -> dict[str, SnapshotReader]:
        """Return the readers of the replicas' snapshots, by name."""

    async def press(
        self, session: str, do: str, by: str, episode: str | None = None
    ) -> dict[str, Any] | None:
        """Give a command to a session, see `CommandBoard.press`; return None if no replica has
        the session.
        """


class Viewer:
    """The data that have not been sent to one viewer yet."""

    def __init__(self) -> None:
        self.shown: frozenset[str] = frozenset()  # the sessions whose pictures the viewer shows
        self._waiting: deque[list[Snapshot]] = deque()
        self._has_data = asyncio.Event()
        self._extra: dict[str, Any] = {}  # the latest value of the document's further entries
        self._sent_extra = self._extra

    def put(self, snapshots: list[Snapshot], extra: dict[str, Any] | None = None) -> None:
        """Queue data to be sent, and drop the oldest if there are too many.

        Args:
            snapshots: The snapshots of all replicas.
            extra: Further entries of the document, which are sent only if they have changed.
        """
        self._waiting.append(snapshots)
        self._has_data.set()
        while len(self._waiting) > 1 and self._is_behind():
            self._waiting.popleft()
        self._extra = extra or self._extra

    async def next(self) -> tuple[dict[str, Any], list[bytes]]:
        """Wait for snapshots; return all that are queued as one document, and the files to which
        it refers.
        """
        await self._has_data.wait()
        self._has_data.clear()
        gathered, self._waiting = self._waiting, deque()

        files: list[bytes] = []
        replicas = []
        for snapshots in gathered:
            for snapshot in snapshots:
                replicas.append(_with_files(snapshot, files, self.shown))

        document = {"time": time.time(), "replicas": replicas}
        if self._extra is not self._sent_extra:
            self._sent_extra = self._extra
            document |= self._extra
        return document, files

    def _is_behind(self) -> bool:
        """Return whether too many snapshots, or too large files, are queued."""
        if len(self._waiting) > _BEHIND:
            return True
        size = 0
        for snapshots in self._waiting:
            for snapshot in snapshots:
                size += sum(map(len, snapshot.files))
        return size > _WAITING_BYTES


class Fleet:
    """Gathers snapshots of all replicas while there are viewers.

    Args:
        view: The view of this replica; None if this process is not a replica.
        other_replicas: The other replicas.
        extra: Returns further entries of the document. If nothing has changed, it returns the same
            object as before.
    """

    def __init__(
        self,
        view: ReplicaView | None,
        other_replicas: OtherReplicas | None = None,
        extra: Callable[[], dict[str, Any]] | None = None,
    ) -> None:
        self._view = view
        self._other_replicas = other_replicas
        self._extra = extra
        self.viewers: set[Viewer] = set()
        self._gathering: asyncio.Task[None] | None = None
        # The number of the last snapshot by name of the replica. "" is this replica.
        self._last_numbers: dict[str, int] = {}

    @contextmanager
    def viewer(self) -> Iterator[Viewer]:
        """Yield a viewer, for which snapshots are gathered within the context. Nothing is gathered
        while there are no viewers.
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

    async def press(
        self, session: str, do: str, by: str, episode: str | None = None
    ) -> dict[str, Any]:
        """Give a command to a session of any replica.

        Args:
            session: The session.
            do: The command, see `CommandBoard.press`.
            by: The name of the caller's key.
            episode: The episode of a mark, see `CommandBoard.press`.

        Returns:
            The description of the command.

        Raises:
            UnknownSession: No replica has the session.
        """
        pressed = None if self._view is None else self._view.press(session, do, by, episode)
        if pressed is None and self._other_replicas is not None:
            pressed = await self._other_replicas.press(session, do, by, episode)
        if pressed is None:
            raise UnknownSession(f"session {session[:80]!r}: no replica has it, so it has ended")
        return pressed

    async def _gather(self) -> None:
        """Gather snapshots for all viewers, at most `live.RATE` times a second."""
        period_s = 1 / live.RATE
        while True:
            begun = time.monotonic()
            try:
                snapshots = await self._snapshots()
                extra = None if self._extra is None else await asyncio.to_thread(self._extra)
            except Exception:
                logger.exception("the live view could not be read; it will be read again")
            else:
                for viewer in self.viewers:
                    viewer.put(snapshots, extra)
            took_s = time.monotonic() - begun
            await asyncio.sleep(max(period_s / 2, period_s - took_s))

    async def _snapshots(self) -> list[Snapshot]:
        """Return the snapshots of all replicas that answer in time."""
        shown = frozenset[str]().union(*(viewer.shown for viewer in self.viewers))
        readers: dict[str, SnapshotReader] = {}
        if self._other_replicas is not None:
            readers |= await self._other_replicas.views()
        view = self._view
        if view is not None:
            readers[""] = view.read_on_thread

        reads = []
        for name, read in readers.items():
            reads.append(read(self._last_numbers.get(name, 0), shown))
        results = await asyncio.gather(*reads, return_exceptions=True)

        snapshots = []
        last_numbers = {}
        for name, result in zip(readers, results, strict=True):
            if isinstance(result, Snapshot):
                snapshots.append(result)
                last_numbers[name] = result.number
            else:
                last_numbers[name] = self._last_numbers.get(name, 0)
        self._last_numbers = last_numbers

        if view is not None:
            result_here = results[-1]
            if isinstance(result_here, BaseException):
                raise result_here
        return snapshots


def _with_files(snapshot: Snapshot, files: list[bytes], shown: Collection[str]) -> dict[str, Any]:
    """Add the pictures of a snapshot to a message.

    Args:
        snapshot: The snapshot.
        files: The files of the message, to which the pictures are added.
        shown: The sessions whose pictures are added.

    Returns:
        The document of the snapshot, which refers to `files`.
    """
    sessions = []
    for session in snapshot.document["sessions"]:
        pictures: dict[str, int] = {}
        if session["id"] in shown:
            for camera, index in session["pictures"].items():
                pictures[camera] = len(files)
                files.append(snapshot.files[index])
        sessions.append(session | {"pictures": pictures})
    return snapshot.document | {"sessions": sessions}
