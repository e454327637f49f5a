"""Records requests and answers of sessions as LeRobotDatasets, on separate threads.

A deployment file turns it on: `parts: {record: {folder: /data/traces}}`.

The thread that handles a message only puts references into a queue. A second thread copies the
observations, since their memory may belong to the client, and a third thread encodes and writes
them. If these threads are too slow, or the disk is full, frames are dropped and counted. No answer
is delayed.
"""

from __future__ import annotations

import logging
import os
import random
import re
import tempfile
import threading
import time
from collections import Counter as Counts
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Literal

from pydantic import Field
from ray.util.metrics import Counter, Gauge

from vlagents_ray.disk import storing
from vlagents_ray.errors import ConfigError, PolicyFailed, StorageFailed, UnknownSession
from vlagents_ray.interface import CAPTURED, POLICY, Obs, copied
from vlagents_ray.protocol.messages import Reply
from vlagents_ray.protocol.values import to_text
from vlagents_ray.registry import require
from vlagents_ray.serve.config.deployment import AbsolutePath
from vlagents_ray.serve.config.parts import PartConfig
from vlagents_ray.serve.engine.metrics_buffer import STAGES
from vlagents_ray.serve.engine.observer import Observer
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.periodic import Periodic, each_half_second
from vlagents_ray.serve.replica.metrics import PERIOD_S, series
from vlagents_ray.serve.replica.part import ReplicaPart
from vlagents_ray.serve.requests import PendingRequest
from vlagents_ray.serve.sessions import SessionTable
from vlagents_ray_live.episodes import KEPT, EpisodeWriter, RecordedAct, RecordingEnded

logger = logging.getLogger(__name__)

NO_VERSION = -1  # the version of the weights for answers that do not contain one
_HELD_BYTES = 256 * 2**20  # maximum size of the observations that wait to be written, bytes
# Estimated size of a request without its pictures and the bytes in its `info`, bytes.
_OTHER_BYTES = 16 * 2**10
_NICE = 5  # niceness: a lower priority than that of the policy's thread
_CLOSING_S = 30.0  # the time for the threads to write the waiting frames, s


class RecordConfig(PartConfig):
    """The settings of a recording."""

    folder: AbsolutePath = Field(
        description="folder of the datasets, on each replica's own node or shared; each replica "
        "writes its own datasets in it"
    )
    share: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="share of the episodes that are recorded, drawn at each reset",
    )
    pictures: Literal["exact", "small"] = Field(
        default="exact",
        description="exact: each pixel as the policy received it, in lossless H.264; small: as in "
        "videos for training, about twenty times smaller, with which the same policy acts slightly "
        "differently",
    )
    fps: float = Field(
        default=10.0,
        gt=0,
        le=10_000,
        description="rate of the frames in the videos, one for each action request",
    )
    most_gb: float = Field(
        default=50.0,
        gt=0,
        le=1_000_000,
        description="size of the folder at which the recording ends, GB",
    )


class Recording(ReplicaPart):
    """Records the sessions of a replica, and exports how many frames are saved and lost."""

    Config = RecordConfig

    def open(self) -> None:
        """Start to record.

        Raises:
            ConfigError: The folder is not writable.
            MissingDependency: The extra "record" is not installed.
        """
        context = self.context
        self.recorder = open_recorder(
            context.engine.sessions, self.settings, context.replica, context.metadata
        )
        self._metrics = RecordingMetrics(self.recorder, context.metric_tags)
        self._metrics.start()

    def observer(self) -> SessionRecorder:
        """Return the recorder."""
        return self.recorder

    def close(self) -> None:
        """Export the last counts."""
        self._metrics.close()


class RecordingMetrics:
    """Exports the counts of a recorder to Ray once a second, on a separate thread.

    Args:
        recorder: The recorder.
        tags: The tags of the replica's series.
    """

    def __init__(self, recorder: SessionRecorder, tags: Mapping[str, str]) -> None:
        make = partial(series, tags)
        self._frames = make(Counter, "recorded_frames", "Acts of recorded sessions.", "outcome")
        # 1 while sessions are recorded, 0 after the recording has ended.
        self._recording = make(Gauge, "recording", "Whether sessions are recorded.")
        self._recorder = recorder
        self._exported = Counts[str]()  # the counts that have been exported already
        self._periodic = Periodic(PERIOD_S)

    def start(self) -> None:
        """Start to export the counts."""
        self._periodic.add(self.export)

    def close(self) -> None:
        """Export the last counts, and end the thread."""
        self._periodic.remove(self.export)
        self.export()

    def export(self) -> None:
        """Export the counts since the last call."""
        self._recording.set(float(self._recorder.ended is None))
        totals = {"saved": self._recorder.saved, "lost": self._recorder.lost}
        for outcome, total in totals.items():
            new = total - self._exported[outcome]
            if new:
                self._frames.inc(new, {"outcome": outcome})
                self._exported[outcome] = total


class Worker:
    """A thread that makes scheduled calls, at a lower priority than the policy's thread. The
    number of waiting calls is not limited.

    Args:
        name: The name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._calls: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, call: Callable[[], None]) -> None:
        """Schedule a call on the thread; an error of the call is logged, and does not end the
        thread.
        """
        self._calls.put(call)

    def close(self, timeout_s: float) -> None:
        """End the thread after the scheduled calls, and wait at most `timeout_s` for that."""
        self._calls.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)

        while True:
            call = self._calls.get()
            if call is None:
                return
            try:
                call()
            except Exception:
                logger.exception("%s: a request is left out", self._thread.name)
            del call  # the memory of a request counts as held until it is freed


@dataclass(slots=True, eq=False)
class _Recorded:
    """A request to be recorded; its memory counts as held until it is garbage-collected."""

    recorder: SessionRecorder
    session: str
    op: str
    received_at: float  # time of arrival, s since 1970
    obs: Obs | None  # the reply; None for a reset or a close
    instruction: str
    # The options of the reset, before the queue removes some of them; `_copy` makes them a text.
    options: Any
    size: int  # the size of the request's memory, bytes
    info: str = ""  # the observation's info, as text

    def __del__(self) -> None:
        self.recorder.count_held(-self.size)


class SessionRecorder(Observer):
    """Records a share of the episodes of one replica until `close`.

    Args:
        writer: The writer of the episodes.
        sessions: The sessions of the replica.
        share: The share of the episodes that are recorded, in [0, 1], drawn at each reset.
    """

    def __init__(
        self, writer: EpisodeWriter, sessions: SessionTable[LoadedModel], *, share: float = 1.0
    ) -> None:
        # The number of requests that exceeded the memory, or whose episode could not be written.
        self.dropped = 0
        self.ended: str | None = None  # the reason why nothing more is recorded
        self._writer = writer
        self._sessions = sessions
        self._share = share

        self._held_bytes = _HELD_BYTES
        self._held = 0  # the size of the waiting requests, bytes
        # Guards `_held`, which the garbage collector may reduce at any time.
        self._lock = threading.RLock()

        # The step at the reset of each session; None if the session is not recorded.
        self._first_steps: dict[str, int | None] = {}
        # Whether a comparison of the current sessions with `_first_steps` is scheduled.
        self._is_comparing = False
        # The sessions in `_first_steps` that were missing in the last comparison.
        self._missing: set[str] = set()

        self._copier = Worker("record-copy")
        self._worker = Worker("record-write")
        each_half_second.add(self._compare_sessions)

    @property
    def saved(self) -> int:
        """The number of frames in complete episodes."""
        return self._writer.saved

    @property
    def lost(self) -> int:
        """The number of action requests that are missing in the recording."""
        return self.dropped + self._writer.lost

    def on_request(self, pending: PendingRequest) -> None:
        """Copy the request for the recording, on another thread."""
        request = pending.request
        if self.ended is not None or request.op not in ("act", "reset", "close"):
            return

        obs = None
        size = 0
        if request.op == "act" and request.obs is not None:
            obs = request.obs
            picture_bytes = sum(image.nbytes for image in obs.cameras.values())
            size = _OTHER_BYTES + picture_bytes + _bytes_in(obs.info)
            if not self._hold(size):
                self.dropped += 1
                return

        recorded = _Recorded(
            recorder=self,
            session=pending.session_id,
            op=request.op,
            received_at=time.time(),
            obs=obs,
            instruction=request.instruction or "",
            options=request.kwargs,
            size=size,
        )
        pending.observer_data[self] = recorded
        self._copier.put(partial(self._copy, recorded))

    def on_answer(self, pending: PendingRequest, reply: Reply) -> None:
        """Record the frame of the answered request."""
        recorded = pending.observer_data.pop(self, None)
        if recorded is not None and reply.error is None:
            self._write_later(partial(self._handle, recorded, reply))

    def close(self) -> None:
        """Write the waiting frames, and complete all episodes, if the disk is fast enough."""
        each_half_second.remove(self._compare_sessions)
        deadline = time.monotonic() + _CLOSING_S
        self._copier.close(_CLOSING_S)
        self._worker.put(partial(self._write, self._writer.close))
        self._worker.close(max(0.0, deadline - time.monotonic()))

    def count_held(self, size: int) -> None:
        """Add `size` bytes to the size of the waiting requests."""
        with self._lock:
            self._held += size

    def _hold(self, size: int) -> bool:
        """Count a waiting request; return False if it exceeds the memory."""
        with self._lock:
            if self._held + size > self._held_bytes:
                return False
            self._held += size
            return True

    def _copy(self, recorded: _Recorded) -> None:
        """Copy the data that may be in the client's memory."""
        try:
            recorded.options = to_text(recorded.options) if recorded.op == "reset" else ""
            obs = recorded.obs
            if obs is not None:
                info = dict(obs.info)
                captured = info.pop(CAPTURED, None)
                recorded.info = to_text(info) if info else ""
                captured_at = recorded.received_at
                if isinstance(captured, (int, float)):
                    captured_at = float(captured)
                recorded.obs = copied(replace(obs, info={CAPTURED: captured_at}, prepared=None))

            texts = len(recorded.options) + len(recorded.info)
            recorded.size += texts
            self.count_held(texts)
        except Exception as error:  # noqa: BLE001 - an error of this request only
            logger.warning(
                "recording: an action request of session %s is left out: %s",
                recorded.session,
                error,
            )
            self.dropped += 1
            recorded.obs = None
            recorded.options = ""

    def _write_later(self, write: Callable[[], None]) -> None:
        """Call a function on the writing thread, after all earlier requests."""
        self._copier.put(lambda: self._worker.put(partial(self._write, write)))

    def _write(self, write: Callable[[], None]) -> None:
        """Call a function that writes; end the recording if the disk or the folder is full."""
        if self.ended is not None:
            return
        try:
            with storing(self._writer.folder, KEPT):
                write()
        except (OSError, StorageFailed, RecordingEnded) as error:
            self.ended = str(error)
            logger.error("recording has ended, but the sessions continue: %s", error)  # noqa: TRY400 - the message contains the reason
            self._writer.close()

    def _handle(self, recorded: _Recorded, reply: Reply) -> None:
        """Begin, continue or end the episode of a session."""
        session = recorded.session
        op = recorded.op

        try:
            if op == "reset":
                is_drawn = random.random() < self._share
                self._first_steps[session] = reply.step if is_drawn else None
                if self._first_steps[session] is None:
                    self._writer.end(session)
                else:
                    weights = to_text(reply.identity) if reply.identity else ""
                    self._writer.begin(session, recorded.instruction, recorded.options, weights)
            elif op == "close":
                self._first_steps.pop(session, None)
                self._writer.end(session)
            elif recorded.obs is not None and self._is_recorded(session):
                if session in self._writer:
                    first_step = self._first_steps[session] or 0
                    self._writer.add(session, _frame(recorded, recorded.obs, reply, first_step))
                else:  # too many sessions are recorded
                    self.dropped += 1

        except (OSError, StorageFailed, RecordingEnded):
            raise
        except UnknownSession:  # the session has ended, and with it its episode
            self.dropped += 1
        except Exception as error:  # noqa: BLE001 - affects one session's episode
            logger.warning("recording: the episode of session %s is lost: %s", session, error)
            self._first_steps[session] = None
            self._writer.drop(session)

    def _is_recorded(self, session: str) -> bool:
        """Return whether the session is recorded; for a session that comes from another replica,
        draw this now.
        """
        if session not in self._first_steps:
            self._first_steps[session] = None
            if random.random() < self._share:
                current = self._sessions.get(session)
                self._first_steps[session] = current.first
                self._writer.begin(session, current.instruction)
        return self._first_steps[session] is not None

    def _compare_sessions(self) -> None:
        """Schedule the search for sessions that have ended; called twice a second."""
        if not self._is_comparing:
            self._is_comparing = True
            self._write_later(partial(self._end_others, frozenset(self._sessions.ids())))

    def _end_others(self, current: frozenset[str]) -> None:
        """End the episodes of sessions that were missing in two comparisons, as a new session may
        be missing in one.
        """
        self._is_comparing = False
        missing = self._first_steps.keys() - current
        for session in missing & self._missing:
            del self._first_steps[session]
            self._writer.end(session)
        self._missing = missing


def open_recorder(
    sessions: SessionTable[LoadedModel],
    args: RecordConfig,
    replica: str,
    metadata: Callable[[], Mapping[str, Any]],
) -> SessionRecorder:
    """Create a recorder of the sessions of a replica.

    Args:
        sessions: The sessions of the replica.
        args: The settings of the recording.
        replica: The name of the replica, which the names of the datasets contain.
        metadata: Returns the metadata of the policy.

    Raises:
        ConfigError: The folder is not writable.
        MissingDependency: The extra "record" is not installed.
    """
    for module in ("av", "pyarrow"):
        require(module)

    folder = Path(args.folder)
    try:
        with storing(folder, "then start the server again"):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
    except (OSError, StorageFailed) as error:
        raise ConfigError(f"parts.record.folder: cannot be written to: {error}") from error

    begun_at = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
    replica_name = re.sub(r"[^A-Za-z0-9]+", "-", replica.removeprefix("SERVE_REPLICA::"))
    writer = EpisodeWriter(
        folder,
        f"{begun_at}-{replica_name}",
        args.fps,
        lossless=args.pictures == "exact",
        most_bytes=args.most_gb * 1e9,
        describe=metadata,
    )
    return SessionRecorder(writer, sessions, share=args.share)


def _frame(recorded: _Recorded, obs: Obs, reply: Reply, first_step: int) -> RecordedAct:
    """Return the frame of a request and its answer.

    Args:
        recorded: The request.
        obs: The observation of the request.
        reply: The answer.
        first_step: The step at the reset of the session.
    """
    act = reply.act
    if act is None:
        raise PolicyFailed("the answer has no action")

    info = {key: value for key, value in act.info.items() if key != "timing"}
    version = info.get(POLICY) or {}
    times_ms = {}
    for name in (*STAGES, "total"):
        times_ms[f"{name}_ms"] = float(reply.timing.get(f"{name}_ms", 0.0))

    columns: dict[str, Any] = {
        "received_at": recorded.received_at,
        **times_ms,
        "batch_size": int(reply.timing.get("batch_size", 1)),
        "policy_version": int(version.get("version", NO_VERSION)),
        "policy_done": bool(act.done),
        "request": recorded.info,
        "answer": to_text(info) if info else "",
    }
    return RecordedAct(
        obs=obs,
        chunk=act.rows(),
        captured_at=float(obs.info[CAPTURED]),
        tick=(reply.step or 0) - first_step - 1,
        columns=columns,
    )


def _bytes_in(value: Any) -> int:
    """Return the approximate size of the texts and arrays in a value, bytes."""
    if isinstance(value, dict):
        return sum(map(_bytes_in, value.values()))
    if isinstance(value, list):
        return sum(map(_bytes_in, value))
    return len(value) if isinstance(value, (str, bytes)) else int(getattr(value, "nbytes", 8))
