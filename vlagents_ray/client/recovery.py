"""The client's part of moving a session: how the session continues after the client has lost an
answer.

A failed request has one of four outcomes (`Outcome`), which follow from its error and the session.
The server's part is `vlagents_ray.serve.scaling.session_migration`: a replica that receives a
request for a session of another replica fetches the session from that replica. Only if no replica
has the session does the client resume it from a `ResumePoint`.
"""

from __future__ import annotations

import time
import uuid
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from vlagents_ray.client.connection import Connection
from vlagents_ray.client.transports.base import ReplicaSilent
from vlagents_ray.errors import (
    ConnectionLost,
    DeadlineExceeded,
    NoReplica,
    NotReset,
    PolicyUnavailable,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import PriorityName, Reply, Request

_FIRST_PAUSE_S = 0.02
_LONGEST_PAUSE_S = 0.5
# No attempt begins if the remaining time is less than the smaller of these two limits, in s and as
# a share of the time limit: a late request would be executed after its caller has given up.
_RESERVE_S, _RESERVE_SHARE = 0.5, 0.25

# Errors after which a reset is sent again. Other errors, such as the error of a full replica, are
# returned to the caller.
_RESET_AGAIN = (ConnectionLost, NoReplica)
# Errors of `act` that mean that no replica has the session. The error is `NotReset` if a reset that
# should have resumed the session failed.
_LOST = (NotReset, UnknownSession, ReplicaSilent)


class Outcome(Enum):
    """The next step of a session after the reply to one of its requests."""

    FINAL = "the reply is the result, even if it is an error"
    AGAIN = "send the request again: the replica that receives it has the session with its state"
    RESUME = "no replica has the session: resume it from its `ResumePoint`"
    UNKNOWN = "the policy may have executed the request: the next request resumes the session"


@dataclass(slots=True)
class ResumePoint:
    """The data with which a client can resume an episode: the arguments of the reset, and the last
    observations.

    A replica that resumes the episode resets the policy, and passes these observations to
    `Observes.observe`. A `SessionState`, which replicas send to each other, also contains the
    policy's own state.
    """

    obs: Obs  # the first observation
    instruction: str | None
    kwargs: dict[str, Any]
    contract: dict[str, Any] | None
    # The last answered observations.
    recent: deque[Obs] = field(default_factory=lambda: deque(maxlen=0))
    step: int | None = 0  # number of actions, counted by the server; None if an answer may be lost


class ClientSession:
    """One session of a connection, and its requests."""

    def __init__(self, connection: Connection, priority: PriorityName) -> None:
        self.id = uuid.uuid4().hex
        # None before the first reset and after the end of an episode.
        self.episode: ResumePoint | None = None
        self.step: int | None = None  # number of actions in the server's last reply, of any episode
        # Whether the episode was resumed and `Act.info` has not reported this yet.
        self.resumed = False
        # Whether the client has left the session's replica because it was silent. The next `act`
        # then begins with a reset, since a search for the session would wait for the silent
        # replica.
        self.is_lost = False
        self._connection = connection
        self._priority: PriorityName = priority

    def reset(self, episode: ResumePoint) -> Request:
        """Return the request that begins `episode`, or resumes it at its current step."""
        return Request(
            "reset",
            episode.obs,
            episode.instruction,
            episode.kwargs,
            episode.contract,
            history=list(episode.recent),
            session=self.id,
            priority=self._priority,
            step=self.step,
            request_id=self._connection.request_id(),
        )

    def act(self, obs: Obs) -> Request:
        """Return the request for an action; raises `NotReset` if no episode has begun."""
        if self.episode is None:
            raise NotReset(
                "expected a reset before act: this agent has no session, or has lost its session; "
                "call reset"
            )
        return Request(
            "act",
            obs,
            session=self.id,
            priority=self._priority,
            step=self.episode.step,
            request_id=self._connection.request_id(),
        )

    def begun(self, reply: Reply) -> None:
        """Record the reply that began, resumed or continued the episode."""
        self.step = reply.step
        self.is_lost = False
        if self.episode is not None:
            self.episode.step = reply.step

    def outcome(self, request: Request, reply: Reply) -> Outcome:
        """Return how the session continues after the reply to its request."""
        error = reply.error
        if request.op == "reset":
            return Outcome.AGAIN if isinstance(error, _RESET_AGAIN) else Outcome.FINAL

        if isinstance(error, DeadlineExceeded):
            return Outcome.UNKNOWN
        if isinstance(error, _LOST):
            return Outcome.RESUME
        if not isinstance(error, PolicyUnavailable):
            return Outcome.FINAL
        # If the request has a step, the replica that receives it checks that no answer was lost.
        has_step = self.episode is not None and self.episode.step is not None
        return Outcome.AGAIN if has_step else Outcome.RESUME

    def failed(self, error: VLAgentsError | None, *, resumes: bool) -> None:
        """Record that `act` returned no action. A lost session needs a reset, unless it
        `resumes`.
        """
        if isinstance(error, DeadlineExceeded) and self.episode is not None:
            self.episode.step = None  # the policy may have computed an action for this observation
        elif isinstance(error, ConnectionLost | UnknownSession) and not resumes:
            self.episode = None

    def begin_again(self, request: Request) -> Request:
        """Return the reset that resumes the session under a new id, and set this id in `request`,
        which is sent after the reset.

        With a new id, any later reply to `request` comes from the new session, even if the reply to
        the reset is late.
        """
        if self.episode is None:
            raise NotReset("act was called before reset; reset first")
        self.id = request.session = uuid.uuid4().hex
        self.resumed = True
        return self.reset(self.episode)


def call_with_recovery(
    connection: Connection,
    sessions: Sequence[ClientSession],
    requests: Sequence[Request],
    timeout_s: float,
) -> list[Reply]:
    """Send one request of each session and return the replies, from another replica if the
    session's replica is gone.

    The call retries until `timeout_s` has passed. Then the reply contains the last error, or
    `DeadlineExceeded` for a session that is not resumed yet. The first action after an episode was
    resumed has `info["resumed"]`.
    """
    deadline = time.monotonic() + timeout_s
    last_attempt = deadline - min(_RESERVE_S, _RESERVE_SHARE * timeout_s)
    replies = _first_replies(connection, sessions, requests, timeout_s)
    first_errors = [reply.error for reply in replies]

    lost: set[int] = set()  # indices of the sessions to be resumed
    pause_s = 0.0
    while True:
        outcomes = [
            session.outcome(request, reply)
            for session, request, reply in zip(sessions, requests, replies, strict=True)
        ]
        failed = [i for i, now in enumerate(outcomes) if now in (Outcome.AGAIN, Outcome.RESUME)]
        if not failed or time.monotonic() + pause_s >= last_attempt:
            break
        time.sleep(pause_s)
        pause_s = min(_LONGEST_PAUSE_S, 2 * pause_s + _FIRST_PAUSE_S)

        # Resume the lost sessions with a reset.
        lost |= {i for i in failed if outcomes[i] is Outcome.RESUME}
        to_resume = [i for i in failed if i in lost]
        if to_resume:
            resets = [sessions[i].begin_again(requests[i]) for i in to_resume]
            resumed = [sessions[i] for i in to_resume]
            reset_replies = _call(connection, resumed, resets, deadline - time.monotonic())
            for i, reply in zip(to_resume, reset_replies, strict=True):
                if reply.error is None:
                    sessions[i].begun(reply)
                    requests[i].step = reply.step
                    lost.discard(i)
                else:
                    replies[i] = reply
        if time.monotonic() >= last_attempt:
            break

        # Send the failed requests of all other sessions again, including the sessions just resumed.
        to_send = [i for i in failed if i not in lost]
        if to_send:
            for i in to_send:
                requests[i].request_id = connection.request_id()
            sent_sessions = [sessions[i] for i in to_send]
            sent_requests = [requests[i] for i in to_send]
            left_s = deadline - time.monotonic()
            new_replies = _call(connection, sent_sessions, sent_requests, left_s)
            for i, reply in zip(to_send, new_replies, strict=True):
                replies[i] = reply

    for session, request, reply, first_error in zip(
        sessions, requests, replies, first_errors, strict=True
    ):
        # The messages of these errors advise a reset, which is not needed here.
        if isinstance(reply.error, NotReset | UnknownSession) and request.op == "act":
            reply.error = DeadlineExceeded(
                f"the session was not resumed within {timeout_s:g} s; the next call of act resumes "
                f"it"
            )
        reply.error = _with_cause(reply.error, first_error)
        if session.resumed and reply.act is not None:
            reply.act.info["resumed"], session.resumed = True, False
    return replies


def _call(
    connection: Connection,
    sessions: Sequence[ClientSession],
    requests: Sequence[Request],
    timeout_s: float,
) -> list[Reply]:
    """Return the replies to one request of each session, and mark the sessions of a silent replica
    as lost.
    """
    replies = connection.call(requests, timeout_s)
    for session, reply in zip(sessions, replies, strict=True):
        session.is_lost = session.is_lost or isinstance(reply.error, ReplicaSilent)
    return replies


def _first_replies(
    connection: Connection,
    sessions: Sequence[ClientSession],
    requests: Sequence[Request],
    timeout_s: float,
) -> list[Reply]:
    """Send requests for the first time and return their replies; return errors instead if a session
    must be resumed first.
    """
    if requests[0].op != "act" or not any(session.is_lost for session in sessions):
        return _call(connection, sessions, requests, timeout_s)

    replies = []
    for session, request in zip(sessions, requests, strict=True):
        error: VLAgentsError = PolicyUnavailable("not sent: another session must be resumed first")
        if session.is_lost:
            error = UnknownSession("the client has left the session's replica, which was silent")
        replies.append(Reply(request.request_id, error=error))
    return replies


def _with_cause(
    error: VLAgentsError | None, first_error: VLAgentsError | None
) -> VLAgentsError | None:
    """Return the last error of a call. If the address no longer answers, add the loss of the
    connection before it, which is the cause.
    """
    if error is first_error or not isinstance(first_error, ConnectionLost):
        return error
    if not isinstance(error, PolicyUnavailable | DeadlineExceeded):
        return error
    return type(error)(f"{error}; before that: {first_error}")
