"""One policy, its sessions and its batch queue: the core of a replica, without Ray.

Every door (HTTP, WebSocket, a Serve handle, …) turns what it receives into a `Request` and calls
`submit`; the reply comes back through a callback on a thread of the batch queue.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol

from vlagents_ray.contract import Contract
from vlagents_ray.errors import NotReset, PolicyFailed, PolicyUnavailable, UnknownSession, VLAgentsError
from vlagents_ray.interface import Act, Agent
from vlagents_ray.serve.answers import answer, explain, require_sendable, timing
from vlagents_ray.serve.batching import BatchQueue, Rank, Ticket
from vlagents_ray.serve.checkpoints import Checkpoints, Wish
from vlagents_ray.serve.leavers import Leavers
from vlagents_ray.serve.model import Loader, Model
from vlagents_ray.serve.models import Models
from vlagents_ray.serve.room import too_late
from vlagents_ray.serve.sessions import Session, SessionTable
from vlagents_ray.serve.stats import Stats
from vlagents_ray.wire.messages import Reply, Request

logger = logging.getLogger(__name__)


class FindsStrays(Protocol):
    """Fetches sessions that are at another replica: `vlagents_ray.serve.moving.Strays`."""

    def fetch(self, session_id: str, then: Callable[[], None]) -> bool:
        """Call `then` when it was tried; False if it will not be."""
        ...


class Engine:
    """Serves an agent, or several of different checkpoints, to many sessions. `start` loads it; `close` ends it."""

    def __init__(
        self,
        agent: Agent | Checkpoints,
        *,
        max_batch_size: int = 16,
        patience: float = 0.0,
        batch_sizes: Sequence[int] = (),
        session_limit: int = 1000,
        session_idle_s: float = 600.0,
        version: str = "",
        check: Callable[[Contract | None], None] = lambda _: None,
    ) -> None:
        """With `batch_sizes` batches are padded up to the next of these; the largest is `max_batch_size`.

        `version` is that of the policy: sessions move between equal ones, of equal settings, only. `check` raises
        what keeps a policy with that contract from being served.
        """
        self._source = agent if isinstance(agent, Checkpoints) else Checkpoints(lambda _: agent)
        self.sessions = SessionTable(session_limit, session_idle_s)
        self.models = Models(self._source, Loader(self._source, version, batch_sizes, check), self.sessions)
        self._batch_sizes = batch_sizes
        self.stats = Stats()
        self._unready: VLAgentsError | None = PolicyUnavailable("the policy is loading; try again")  # for clients
        self._failure: PolicyFailed | None = None  # why it did not load, for the operator
        self.strays: FindsStrays | None = None  # where to look for a session that is not here
        self.draining = False  # the replica will stop, and others will go on: clients are told
        self.leavers = Leavers()  # told the same although it goes on, since others hold fewer sessions
        self.queue = BatchQueue(
            self._run,
            max_batch_size,
            prepare=self.models.start,
            idle=self.sessions.drop_idle,
            idle_s=session_idle_s / 10,
            patience=patience,
            is_open=self.sessions.__contains__,
        )

    def start(self) -> None:
        """Initialize the agent; returns when it can act, raises `PolicyFailed` if it cannot."""
        try:
            self.queue.start()
        except Exception as error:
            failed = f"the policy did not load: {type(error).__name__}"
            self._unready = PolicyFailed(f"{failed}; the server's log says why")
            self._failure = PolicyFailed(f"{failed}: {error}")
            raise self._failure from error
        self._unready = None

    @property
    def ready(self) -> bool:
        """Can it act?"""
        try:
            self.check_health()
        except Exception:  # noqa: BLE001 - whatever a policy says is wrong with it
            return False
        return True

    def require_ready(self) -> None:
        """Raise `PolicyUnavailable` while the policy loads, `PolicyFailed` if it could not or has died."""
        if self._unready is not None:
            raise self._unready
        if not self.queue.alive():
            raise PolicyFailed("the policy's thread has ended")

    def check_health(self) -> None:
        """As `require_ready`, with the whole reason, and what the agents say of themselves.

        For the operator, and whoever may have to replace the replica.
        """
        if self._failure is not None:
            raise self._failure
        self.require_ready()
        self.models.check_health()

    def close(self) -> None:
        """Answer what waits with 503, finish the batch under way, close the agent."""
        self.queue.close(timeout_s=30)
        self.models.close()

    @property
    def contract(self) -> Contract | None:
        """Of the deployment's own checkpoint; None as long as there is none."""
        return self.models.contract

    @property
    def version(self) -> tuple[str, str]:
        """Equal in replicas that can take each other's sessions over."""
        return self.models.version

    def ticket(
        self,
        session_id: str,
        request: Request,
        done: Callable[[Reply], None],
        *,
        owner: str = "",
        turn: str = "",
        transport: str = "",
        quota: tuple[str, int | None] | None = None,
    ) -> Ticket:
        """A request made ready for the queue, its answer to go to `done`. What is wrong with it is raised here.

        `owner` is the connection that the session ends with; empty for a caller without one. `turn` is
        whose turn it is in the queue, if that is more than this session. `quota`: see `SessionTable.open`.
        """
        self.require_ready()
        rank = Rank.SIMULATION if request.rank == "simulation" else Rank.ROBOT
        ticket = Ticket(session_id, request, done, rank, owner=turn, connection=owner, transport=transport)
        if request.op == "act":
            session = self.sessions.get(session_id)
            if session.agent is None:
                raise NotReset(f"session {session_id!r}: act before a successful reset; reset first")
            session.owner, session.transport, session.connection = owner, transport, turn
            if (model := session.model) is not None:  # which another thread may take away
                model.check(request)
        elif request.op == "reset":
            ticket.wish, request.kwargs = self._source.wish(request.kwargs)
            if (model := self.models.loaded(ticket.wish)) is not None:  # else when it is
                model.check(request)
            self.sessions.open(session_id, owner, transport, turn, quota)
        return ticket

    def submit(self, session_id: str, request: Request, done: Callable[[Reply], None]) -> Ticket:
        """Queue a request: `ticket`, and put it."""
        ticket = self.ticket(session_id, request, done)
        self.queue.put(ticket)
        return ticket

    def adopt(self, session_id: str, state: dict[str, Any], timeout_s: float = 0.0) -> None:
        """Go on with a session that another replica gave up: the `info` of its answer to "export".

        Its checkpoint may be loaded for it if that takes no longer than `timeout_s`.
        """
        self.require_ready()
        arriving = Session(session_id)
        try:
            model = self.models.adopt(arriving, Wish(*state["wish"]), state["settings"], timeout_s)
            if tuple(state["version"]) != model.version:
                raise UnknownSession(f"session {session_id!r}: of another version of the policy; reset it")
            agent = model.copies.load(state["agent"])
            session = self.sessions.open(session_id)
            self.models.pass_on(arriving, session)
            session.agent, session.steps = agent, state["steps"]
        finally:
            self.models.release(arriving)

    def _run(self, batch: Sequence[Ticket]) -> None:
        """Answer every ticket of a batch. Runs on the policy's thread."""
        acting: dict[Model, list[tuple[Ticket, Session]]] = {}
        for ticket in batch:
            try:
                if ticket.request.op == "act":
                    session, model = self._ready(ticket)
                    acting.setdefault(model, []).append((ticket, session))
                elif ticket.request.op == "reset":
                    self._reset(ticket)
                elif ticket.request.op == "export":
                    self._export(ticket)
                elif ticket.request.op == "observe":
                    self._observe(ticket)
                elif ticket.request.op == "adopt":
                    self.adopt(ticket.session_id, ticket.request.kwargs)
                    ticket.answer(Reply(ticket.request.request_id, info={}))
                else:
                    self.sessions.close(ticket.session_id)
                    ticket.answer(Reply(ticket.request.request_id, info={}))
            except Exception as error:  # noqa: BLE001 - becomes the reply
                ticket.answer(Reply(ticket.request.request_id, error=explain(error, ticket)))
        for model, group in acting.items():
            self._act(model, group)

    def _ready(self, ticket: Ticket) -> tuple[Session, Model]:
        session = self.sessions.get(ticket.session_id)
        model = session.model
        if session.agent is None:  # a reset ahead of it in the queue failed, or waits for its checkpoint
            raise NotReset(f"session {ticket.session_id!r}: its last reset failed; reset again")
        step = ticket.request.step
        if step is not None and step != session.steps:
            raise UnknownSession(
                f"session {ticket.session_id!r}: has {session.steps} acts behind it here, {step} as its client "
                f"knows; an answer was lost: reset it"
            )
        if model is None:
            raise UnknownSession(f"session {ticket.session_id!r}: has just been closed; reset it")
        return session, model

    def _export(self, ticket: Ticket) -> None:
        """Give the session up, to whoever asked: all that another replica needs to go on with it."""
        session = self.sessions.get(ticket.session_id)
        model = session.model
        if session.agent is None or model is None:
            raise UnknownSession(f"session {ticket.session_id!r}: not reset yet")
        state = {
            "agent": model.copies.dump(session.agent),
            "steps": session.steps,
            "version": list(model.version),
            "wish": [model.wish.choice, model.wish.step],
            "settings": model.settings,
        }
        self.sessions.close(ticket.session_id)
        ticket.answer(Reply(ticket.request.request_id, info=state))

    def _observe(self, ticket: Ticket) -> None:
        session, model = self._ready(ticket)
        if session.agent is not None and ticket.request.obs is not None:  # `_ready` and the decoder have seen to both
            with model.busy:
                model.require_open()
                session.agent.observe(ticket.request.obs)
        ticket.request.obs = None
        ticket.answer(Reply(ticket.request.request_id, info={}))

    def _reset(self, ticket: Ticket) -> None:
        if ticket.loaded is None:
            session = self.sessions.open(ticket.session_id, ticket.connection, ticket.transport, ticket.owner)
            session.agent, session.steps, session.resetting = None, 0, ticket
            given_up = partial(_given_up, ticket, session)
            if self.models.hold(session, ticket.wish, partial(self._go_on, ticket), given_up) is None:
                return  # it comes back by `_go_on`
        else:
            session = self.sessions.get(ticket.session_id)
            if session.resetting is not ticket:
                raise UnknownSession(f"session {ticket.session_id!r}: reset anew, or closed, while this reset waited")
            if _given_up(ticket, session):
                self.models.let_go(session)
                raise too_late(ticket.wish)
        session.resetting = None
        try:
            self._begin(ticket, session)
        except BaseException:
            self.models.let_go(session)  # it may be kept for long without being reset again
            raise

    def _begin(self, ticket: Ticket, session: Session) -> None:
        """The episode, by the model that the session holds."""
        request, model = ticket.request, session.model
        if model is None or request.obs is None:  # the decoder has seen to the second
            raise UnknownSession(f"session {ticket.session_id!r}: closed before its reset was over")
        model.check(request)
        begun = time.perf_counter()
        with model.busy:
            model.require_open()
            agent = model.copies.make()
            info = agent.reset(request.obs, request.instruction, **request.kwargs)
            if not isinstance(info, dict):
                raise PolicyFailed(f"reset: the policy returned {type(info).__name__}, want a dict")
            for obs in request.history:
                agent.observe(obs)
        if model.checkpoint is not None:
            info = {**info, "checkpoint": model.checkpoint}  # which is what was loaded, whatever the policy says
        spent = timing(ticket.arrived, begun, time.perf_counter())
        require_sendable(info)
        session.agent = agent
        model.padding.remember(request)
        request.obs, request.history = None, []
        ticket.answer(Reply(request.request_id, info=info, step=0, timing=spent))

    def _go_on(self, ticket: Ticket, error: VLAgentsError | None) -> None:
        """With a reset whose checkpoint is there, or did not load."""
        ticket.loaded = time.perf_counter()
        try:
            if error is not None:
                raise error
            self.queue.put(ticket)
        except VLAgentsError as reason:
            ticket.request.obs, ticket.request.history = None, []  # its session may remember the ticket
            ticket.answer(Reply(ticket.request.request_id, error=reason))

    def _act(self, model: Model, acting: list[tuple[Ticket, Session]]) -> None:
        """Answer the acts of sessions of one model."""
        observations = [ticket.request.obs for ticket, _ in acting]
        agents = [session.agent for _, session in acting]
        padding = model.padding.sessions(len(acting)) if self._batch_sizes else []
        observations += observations[-1:] * len(padding)
        rows = len(observations)
        begun = time.perf_counter()
        results: Sequence[Act | Exception]
        try:
            with model.busy:
                model.require_open()
                results = model.agent.act_batch(observations, agents + padding)  # type: ignore[arg-type]
                synchronise()
            if len(results) != rows:
                raise PolicyFailed(f"act_batch: got {rows} observations, returned {len(results)} actions")
        except Exception as error:  # noqa: BLE001 - becomes the replies
            results = [error] * rows
        ended = time.perf_counter()
        del observations  # which may lie in memory that their sender wants back
        for ticket, _ in acting:
            ticket.request.obs = None
        if padding:
            model.padding.judge(results[len(acting) :])
            results = results[: len(acting)]
        hurries = self.queue.hurries()
        unsent = []
        for (ticket, session), result in zip(acting, results, strict=True):
            reply = answer(ticket, session, result, model.contract)
            reply.timing = {**timing(ticket.arrived, begun, ended), "batch_size": len(acting)}
            if hurries and ticket.rank is not Rank.ROBOT:
                unsent.append((ticket, reply))
            else:
                ticket.answer(reply)
        if unsent:
            self.queue.answer_later(unsent)
        self.stats.batch(len(acting), rows)


def _given_up(ticket: Ticket, session: Session) -> bool:
    """Does nobody wait for that reset any more, or was the session reset again?"""
    return ticket.cancelled or ticket.expired(time.perf_counter()) or session.resetting is not ticket


def synchronise() -> None:
    """Wait for the GPU, so that `inference_ms` is the truth."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        torch.cuda.synchronize()
