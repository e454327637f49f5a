"""What viewers see of one replica: numbers as a JSON document, and pictures as files."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.protocol.json_messages import plain_values
from vlagents_ray.serve.config.deployment import LiveArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.metrics_buffer import SAMPLE, STAGES
from vlagents_ray.serve.live.commands import CommandBoard
from vlagents_ray.serve.live.ring import Ring
from vlagents_ray.serve.live.tap import ENCODING_SHARE, RATE, ROWS, VALUES, Answer, LiveTap, Played, Seen
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.periodic import each_half_second
from vlagents_ray.serve.queue.batch_queue import LoadMeter
from vlagents_ray.serve.sessions import Session

_SESSIONS = 256  # most sessions of a replica that are described
_INSTRUCTION = 1000  # most characters of an instruction
PICTURES = 2**24  # most bytes of the pictures in a snapshot; further sessions have none
_STATE_S = 0.5  # time for which slow things are not looked up again
_SHOWN_OPS = ("act", "reset")


@dataclass(slots=True)
class Snapshot:
    """One replica since the snapshot before."""

    number: int  # of the last answer or observation in it
    document: dict[str, Any]
    files: list[bytes] = field(default_factory=list)  # which `document` refers to by their index


class ReplicaView:
    """Makes the snapshots of one replica; each viewer of another process states how far it has read."""

    def __init__(
        self,
        engine: Engine,
        name: str,
        node: str,
        metadata: Callable[[], Mapping[str, Any]],
        settings: LiveArgs | None = None,
    ) -> None:
        """Create the view of the replica `name` on `node`, whose `engine` acts as `metadata` describes.

        With `settings`, the last seconds of each session are held, from `open` on.
        """
        self._engine = engine
        self._about = {"name": name, "node": node, "ring_s": None if settings is None else settings.ring_s}
        self._metadata = metadata
        self.commands = CommandBoard(engine.sessions, self._see_all, save=self._save)
        self.tap = LiveTap(self._show, commands=self.commands)
        self.ring = None if settings is None else Ring(self.tap, engine.sessions, settings, name)
        self._meter: LoadMeter | None = None
        self._slow: dict[str, Any] = {}
        self._measured = float("-inf")
        self._pictured: dict[str, int] = {}  # number of the observation whose pictures were read last, by session

    def open(self) -> None:
        """Begin to end the leases of viewers that no longer look."""
        each_half_second.add(self.tap.expire)
        if self.ring is not None:
            self.ring.open()

    def close(self) -> None:
        """Stop that."""
        if self.ring is not None:
            self.ring.close()
        each_half_second.remove(self.tap.expire)
        self._engine.observers.remove(self.tap)

    def read(self, since: int, shown: Collection[str]) -> Snapshot:
        """Return what happened since the snapshot with the number `since`, with pictures of the sessions `shown`.

        It may take milliseconds, so it does not belong on an event loop or the policy's thread.
        """
        engine, tap = self._engine, self.tap
        tap.renew(viewer=True)
        answers = tap.answers(since)
        snapshot = Snapshot(answers[-1].number if answers else since, {})
        last = {one.session: one for one in answers if one.op in _SHOWN_OPS}
        played: dict[str, list[Played]] = {}
        for one in answers:
            if one.played is not None:
                played.setdefault(one.session, []).append(one.played)
        tap.forget_others(engine.sessions.ids())
        self.commands.forget_others(engine.sessions.ids())
        held = sorted(engine.sessions.all(), key=lambda one: one.id)[:_SESSIONS]
        sessions = {session.id: _session(session, last.get(session.id), played.get(session.id, [])) for session in held}
        begun = time.thread_time()
        longest_without = sorted(sessions, key=lambda name: self._pictured.get(name, 0))
        for name in longest_without:
            seen, described = tap.seen(name), sessions[name]
            described["commands"] = self.commands.of(name)
            if seen is None or seen.number <= since:
                continue
            snapshot.number = max(snapshot.number, seen.number)
            described["state"] = {part: _numbers(values[:VALUES]) for part, values in seen.state.items()}
            if name in shown and time.thread_time() - begun < ENCODING_SHARE / RATE:
                described["pictures"] = _pictures(seen, snapshot.files)
                if described["pictures"]:
                    self._pictured[name] = seen.number
        snapshot.document = {
            **self._about,
            **self._state(),
            **_counted(answers),
            "waiting": {rank.name.lower(): depth for rank, depth in engine.queue.depth_by_rank().items()},
            "sessions": list(sessions.values()),
            "sessions_held": len(engine.sessions),
        }
        return snapshot

    def _save(self, session: str) -> str:
        if self.ring is None:
            raise ConfigError("save: this server keeps nothing; state `live: {folder: ...}` in its deployment file")
        return self.ring.save(session)

    def _see_all(self, seconds: float) -> None:
        self.tap.renew(seconds)

    def _show(self, tap: LiveTap | None) -> None:
        if tap is None:
            self._engine.observers.remove(self.tap)
        else:
            self._engine.observers.add(tap)
        self._pictured = {}
        self._meter = None if tap is None else LoadMeter(self._engine.queue)

    def _state(self) -> dict[str, Any]:
        """Return what changes slowly, and takes long to find out."""
        engine, now = self._engine, time.monotonic()
        if now - self._measured > _STATE_S:
            metadata = self._metadata()
            self._slow = {
                "policy": metadata["policy"],
                "checkpoint": metadata["checkpoint"],
                "digest": (metadata["weights"] or {}).get("digest"),
                "weights": metadata["policy_version"],
                "devices": engine.models.devices,
                "ready": engine.ready,
                "step": engine.models.step,
                "session_limit": engine.sessions.limit,
                "utilisation": 0.0 if self._meter is None else round(self._meter.read().utilisation, 3),
            }
            self._measured = now
        return self._slow


def _session(session: Session[LoadedModel], last: Answer | None, played: list[Played]) -> dict[str, Any]:
    """Return a session as a viewer needs it, with its last answer and what it executed, if there is something new."""
    weights = session.weights
    described = {
        "id": session.id,
        "transport": session.origin.transport,
        "step": session.steps - session.first,
        "instruction": session.instruction[:_INSTRUCTION],
        "silent_s": round(time.monotonic() - session.used, 2),
        "version": None if weights is None else weights.number,
        "follows": session.follows,
        "pictures": {},
    }
    if played:
        said: dict[str, Any] = plain_values(played[-1].said)
        steps = [step for one in played for step in one.steps.tolist()]
        rows = [row for one in played for row in _numbers(one.rows)]
        described["played"] = said | {"steps": steps[-ROWS:], "rows": rows[-ROWS:]}
    return described if last is None else described | {"rank": last.rank, "last": _act(last)}


def _pictures(seen: Seen, files: list[bytes]) -> dict[str, int]:
    """Add the pictures of an observation to `files`, encoding those that came as pixels; return their indices."""
    found = seen.pictures()
    if sum(map(len, files)) + sum(map(len, found.values())) > PICTURES:
        return {}
    files += found.values()
    return dict(zip(found, range(len(files) - len(found), len(files)), strict=True))


def _act(answer: Answer) -> dict[str, Any]:
    """Return an answer as a viewer needs it."""
    ms = {name: round(value, 3) for name, value in answer.timing.items()}
    found: dict[str, Any] = {"n": answer.number, "op": answer.op, "ms": ms}
    if answer.error:
        return found | {"error": answer.error, "detail": answer.detail}
    if answer.action is not None:
        found |= {"rows": answer.rows, "action": _numbers(answer.action), "done": answer.done}
        found["info"] = plain_values(answer.info)
        if answer.played is not None:
            found["at"] = answer.played.said.get("step")
    return found


def _numbers(values: np.ndarray) -> list[Any]:
    """Return the values, rounded to the digits that a page shows."""
    found: list[Any] = plain_values(np.round(values.astype(float), 4))
    return found


def _counted(answers: list[Answer]) -> dict[str, Any]:
    """Return the acts and errors among the answers, the sizes of the acts' batches, and times of all acts, ms."""
    acts = [one.timing for one in answers if one.op == "act" and not one.error]
    sample = acts[:: max(1, len(acts) // SAMPLE)]
    return {
        "acts": len(acts),
        "errors": dict(Counter(one.error for one in answers if one.error)),
        "batch_sizes": [int(timing.get("batch_size", 1)) for timing in sample],
        "ms": {name: [round(timing.get(f"{name}_ms", 0.0), 3) for timing in sample] for name in (*STAGES, "total")},
    }
