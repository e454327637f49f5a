"""The client's record of a session: what it needs to begin it again on another replica, and when it must."""

from __future__ import annotations

import time
import uuid
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.client.connection import Connection
from vlagents_ray.errors import ConnectionLost, DeadlineExceeded, NoReplica, NotReset, PolicyUnavailable, UnknownSession
from vlagents_ray.interface import Obs, copied
from vlagents_ray.protocol.messages import RankName, Reply, Request

# no replica has the session; `NotReset` if it was to begin again and did not in time
_LOST = (NotReset, UnknownSession)
# Errors after which another replica may answer; a living one refuses a reset for instance because it is full.
_RETRYABLE = {"reset": (ConnectionLost, NoReplica), "act": (ConnectionLost, PolicyUnavailable, *_LOST)}
_FIRST_PAUSE_S = 0.02
_LONGEST_PAUSE_S = 0.5
# No attempt begins with less time left: a request that takes long to arrive would be executed after its caller gave up.
_RESERVE_S, _RESERVE_SHARE = 0.5, 0.25


@dataclass(slots=True)
class EpisodeState:
    """An episode in progress."""

    obs: Obs  # the first observation
    instruction: str | None
    kwargs: dict[str, Any]
    contract: dict[str, Any] | None
    recent: deque[Obs] = field(default_factory=lambda: deque(maxlen=0))  # the last observations that were answered
    step: int | None = 0  # the server's count of acts; None when an answer may have been lost


class ClientSession:
    """One session of a connection, and its requests."""

    def __init__(self, connection: Connection, rank: RankName) -> None:
        self.id = uuid.uuid4().hex
        self.episode: EpisodeState | None = None  # None until its first reset, and after its end
        self.step: int | None = None  # the server's count in its last reply, of any episode
        self.resumed = False  # the episode was begun again, and no action has reported it yet
        self._connection = connection
        self._rank: RankName = rank

    def reset(self, episode: EpisodeState) -> Request:
        """Return the request that begins `episode`, or begins it again at its current step."""
        return Request(
            "reset",
            episode.obs,
            episode.instruction,
            episode.kwargs,
            episode.contract,
            history=list(episode.recent),
            session=self.id,
            rank=self._rank,
            step=self.step,
            request_id=self._connection.request_id(),
        )

    def act(self, obs: Obs) -> Request:
        """Return the request for an action; raises `NotReset` outside an episode."""
        if self.episode is None:
            raise NotReset("act before reset: this agent has no session, or lost it; reset first")
        request_id = self._connection.request_id()
        return Request("act", obs, session=self.id, rank=self._rank, step=self.episode.step, request_id=request_id)

    def begun(self, reply: Reply) -> None:
        """Note the reply that began the episode, or began it again."""
        self.step = reply.step
        if self.episode is not None:
            self.episode.step = reply.step

    def acted(self, obs: Obs, reply: Reply) -> None:
        """Note that `obs` was answered."""
        self.step = reply.step
        if self.episode is not None:
            self.episode.step = reply.step
            if self.episode.recent.maxlen:
                self.episode.recent.append(copied(obs))

    def is_lost(self, reply: Reply) -> bool:
        """Whether the session must begin again; if not, its replica checks that no answer was lost."""
        return isinstance(reply.error, _LOST) or self.episode is None or self.episode.step is None

    def begin_again(self, request: Request) -> Request:
        """Return the reset that begins the session again under a new id; `request` follows it, with that id.

        With a new id, any reply to `request` from now on comes from the new session, even if that to the reset is late.
        """
        if self.episode is None:
            raise NotReset("act before reset; reset first")
        self.id = request.session = uuid.uuid4().hex
        self.resumed = True
        return self.reset(self.episode)


def call_with_recovery(
    connection: Connection, sessions: Sequence[ClientSession], requests: Sequence[Request], timeout_s: float
) -> list[Reply]:
    """Return the reply to one request of each session, from another replica if theirs is gone.

    Retries until `timeout_s` is over; then the reply holds the last error, or `DeadlineExceeded` for a session that has
    yet to begin again. The first action after an episode was begun again says so in `info["resumed"]`.
    """
    deadline = time.monotonic() + timeout_s
    last_attempt = deadline - min(_RESERVE_S, _RESERVE_SHARE * timeout_s)
    replies = connection.call(requests, timeout_s)
    lost: set[int] = set()  # sessions whose state no replica has
    pause_s = 0.0
    while gone := [i for i, reply in enumerate(replies) if isinstance(reply.error, _RETRYABLE[requests[i].op])]:
        if time.monotonic() + pause_s >= last_attempt:
            break
        time.sleep(pause_s)
        pause_s = min(_LONGEST_PAUSE_S, 2 * pause_s + _FIRST_PAUSE_S)
        lost |= {i for i in gone if requests[i].op == "act" and sessions[i].is_lost(replies[i])}
        if again := [i for i in gone if i in lost]:
            resets = [sessions[i].begin_again(requests[i]) for i in again]
            for i, reply in zip(again, connection.call(resets, deadline - time.monotonic()), strict=True):
                if reply.error is None:
                    sessions[i].begun(reply)
                    requests[i].step = reply.step
                    lost.discard(i)
                else:
                    replies[i] = reply
        retry = [i for i in gone if i not in lost]
        if time.monotonic() >= last_attempt:
            break
        if retry:
            for i in retry:
                requests[i].request_id = connection.request_id()
            answers = connection.call([requests[i] for i in retry], deadline - time.monotonic())
            for i, reply in zip(retry, answers, strict=True):
                replies[i] = reply
    for session, request, reply in zip(sessions, requests, replies, strict=True):
        # these errors ask for a reset, which is not needed here
        if isinstance(reply.error, _LOST) and request.op == "act":
            reply.error = DeadlineExceeded(f"the session did not begin again within {timeout_s:g} s; the next act does")
        if session.resumed and reply.act is not None:
            reply.act.info["resumed"], session.resumed = True, False
    return replies
