"""A session as its client knows it: enough to begin it again on another replica, and when that must be."""

from __future__ import annotations

import time
import uuid
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.client.connection import Connection
from vlagents_ray.errors import ConnectionLost, NotReset, PolicyUnavailable, UnknownSession
from vlagents_ray.interface import Obs
from vlagents_ray.wire.messages import RankName, Reply, Request

_GONE = (ConnectionLost, PolicyUnavailable, UnknownSession)  # the session may go on elsewhere
_FIRST_PAUSE_S = 0.02
_LONGEST_PAUSE_S = 0.5


@dataclass(slots=True)
class Episode:
    """An episode under way."""

    obs: Obs  # the first
    instruction: str | None
    kwargs: dict[str, Any]
    contract: dict[str, Any] | None
    recent: deque[Obs] = field(default_factory=lambda: deque(maxlen=0))  # the last ones that were acted on
    step: int | None = 0  # acts behind it, as the server counts; None when an answer may have been lost

    def acted(self, obs: Obs, step: int | None) -> None:
        """`obs` was answered."""
        self.step = step
        if self.recent.maxlen:
            self.recent.append(copied(obs))


class Session:
    """One session of a connection, and its requests."""

    def __init__(self, connection: Connection, rank: RankName) -> None:
        self.id = uuid.uuid4().hex
        self.episode: Episode | None = None  # None until its first reset, and after its end
        self._connection = connection
        self._rank: RankName = rank

    def reset(self, episode: Episode) -> Request:
        """The request that begins `episode`, or begins it again where it is now."""
        return Request(
            "reset",
            episode.obs,
            episode.instruction,
            episode.kwargs,
            episode.contract,
            history=list(episode.recent),
            session=self.id,
            rank=self._rank,
            request_id=self._connection.request_id(),
        )

    def act(self, obs: Obs) -> Request:
        """The request for an action; `NotReset` outside an episode."""
        if self.episode is None:
            raise NotReset("act before reset: this agent has no session, or lost it; reset first")
        request_id = self._connection.request_id()
        return Request("act", obs, session=self.id, rank=self._rank, step=self.episode.step, request_id=request_id)

    def is_lost(self, reply: Reply) -> bool:
        """Must the session begin again? If not, the replica that has it checks that no answer was lost."""
        return isinstance(reply.error, UnknownSession) or self.episode is None or self.episode.step is None

    def begin_again(self, request: Request) -> Request:
        """Under another name, lest what is left of the old session is met; `request` is what comes after."""
        if self.episode is None:
            raise NotReset("act before reset; reset first")
        self.id = request.session = uuid.uuid4().hex
        self.episode.step = request.step = 0
        return self.reset(self.episode)


def persist(
    connection: Connection, sessions: Sequence[Session], requests: Sequence[Request], timeout_s: float
) -> list[Reply]:
    """The replies to one request of each session, from another replica if theirs is gone.

    Tried until `timeout_s` is over; then the reply is the last error. What was begun
    again for it says so in `act.info["resumed"]`.
    """
    deadline = time.monotonic() + timeout_s
    replies = connection.call(requests, timeout_s)
    lost: set[int] = set()  # whose state no replica has
    resumed: set[int] = set()
    pause_s = 0.0
    while gone := [i for i, reply in enumerate(replies) if _may_go_on(requests[i], reply)]:
        if time.monotonic() + pause_s >= deadline:
            break
        time.sleep(pause_s)
        pause_s = min(_LONGEST_PAUSE_S, 2 * pause_s + _FIRST_PAUSE_S)
        lost |= {i for i in gone if requests[i].op == "act" and sessions[i].is_lost(replies[i])}
        if again := [i for i in gone if i in lost]:
            resets = [sessions[i].begin_again(requests[i]) for i in again]
            for i, reply in zip(again, connection.call(resets, deadline - time.monotonic()), strict=True):
                if reply.error is None:
                    lost.discard(i)
                    resumed.add(i)
                else:
                    replies[i] = reply
        if retry := [i for i in gone if i not in lost]:
            for i in retry:
                requests[i].request_id = connection.request_id()
            answers = connection.call([requests[i] for i in retry], deadline - time.monotonic())
            for i, reply in zip(retry, answers, strict=True):
                replies[i] = reply
    for i in resumed:
        if (act := replies[i].act) is not None:
            act.info["resumed"] = True
    return replies


def copied(obs: Obs) -> Obs:
    """With arrays of its own: a caller may write its next observation into the same memory."""
    return Obs(
        {name: np.array(image) for name, image in obs.cameras.items()},
        obs.gripper,
        {name: np.array(part) for name, part in obs.state.items()},
        {key: np.array(value) if isinstance(value, np.ndarray) else value for key, value in obs.info.items()},
    )


def _may_go_on(request: Request, reply: Reply) -> bool:
    """Is this an answer that a living replica would not give? A reset that is refused, as by a full one, stays so."""
    return reply.error is not None and isinstance(reply.error, ConnectionLost if request.op == "reset" else _GONE)
