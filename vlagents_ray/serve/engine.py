"""One policy, its sessions and its batch queue: the core of a replica, without Ray.

Every door (HTTP, WebSocket, a Serve handle, …) turns what it receives into a `Request` and calls
`submit`; the reply comes back through a callback on a thread of the batch queue.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from vlagents_ray.contract import Contract, check_action, check_observation, require_match
from vlagents_ray.errors import InvalidInput, NotReset, PolicyFailed, PolicyUnavailable, UnknownSession, VLAgentsError
from vlagents_ray.interface import Act, Agent
from vlagents_ray.serve.batching import BatchQueue, Rank, Ticket
from vlagents_ray.serve.leavers import Leavers
from vlagents_ray.serve.padding import Padding
from vlagents_ray.serve.sessions import AgentCopies, Session, SessionTable
from vlagents_ray.serve.stats import Stats
from vlagents_ray.wire.messages import Reply, Request
from vlagents_ray.wire.tree import Writer

logger = logging.getLogger(__name__)


class FindsStrays(Protocol):
    """Fetches sessions that are at another replica: `vlagents_ray.serve.moving.Strays`."""

    def fetch(self, session_id: str, then: Callable[[], None]) -> bool:
        """Call `then` when it was tried; False if it will not be."""
        ...


class Engine:
    """Serves an agent to many sessions. `start` loads it; `close` ends it."""

    def __init__(
        self,
        agent: Agent,
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

        `version` is that of the policy and its settings: sessions move between equal ones only. `check` raises
        what keeps a policy with that contract from being served.
        """
        self._check = check
        self._agent = agent
        self._version = version
        self._batch_sizes = batch_sizes
        self._padding = Padding((), lambda: agent)  # until the agent can be copied
        self.stats = Stats()
        self._copies: AgentCopies | None = None
        self._unready: VLAgentsError | None = PolicyUnavailable("the policy is loading; try again")
        self.contract: Contract | None = None
        self.strays: FindsStrays | None = None  # where to look for a session that is not here
        self.draining = False  # the replica will stop, and others will go on: clients are told
        self.leavers = Leavers()  # told the same although it goes on, since others hold fewer sessions
        self.sessions = SessionTable(session_limit, session_idle_s)
        self.queue = BatchQueue(
            self._run,
            max_batch_size,
            prepare=self._prepare,
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
            text = f"the policy did not load: {type(error).__name__}: {error}"
            self._unready = PolicyFailed(text)
            raise self._unready from error
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
        """As `require_ready`, and what the agent itself says; for a replica that may have to be replaced."""
        self.require_ready()
        self._agent.check_health()

    def close(self) -> None:
        """Answer what waits with 503, finish the batch under way, close the agent."""
        self.queue.close(timeout_s=30)
        self._agent.close()

    @property
    def version(self) -> tuple[str, str]:
        """Equal in replicas that can take each other's sessions over."""
        return self._version, "" if self._copies is None else self._copies.fingerprint

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
        if request.op == "act":
            session = self.sessions.get(session_id)
            if session.agent is None:
                raise NotReset(f"session {session_id!r}: act before a successful reset; reset first")
            session.owner, session.transport, session.connection = owner, transport, turn
        elif request.op == "reset" and request.contract is not None:
            require_match(self.contract, Contract.from_json(request.contract))
        for obs in (*request.history, request.obs):
            if obs is not None:
                check_observation(obs, self.contract)
        if request.op == "reset":
            self.sessions.open(session_id, owner, transport, turn, quota)
        rank = Rank.SIMULATION if request.rank == "simulation" else Rank.ROBOT
        return Ticket(session_id, request, done, rank, owner=turn, connection=owner, transport=transport)

    def submit(self, session_id: str, request: Request, done: Callable[[Reply], None]) -> Ticket:
        """Queue a request: `ticket`, and put it."""
        ticket = self.ticket(session_id, request, done)
        self.queue.put(ticket)
        return ticket

    def adopt(self, session_id: str, state: dict[str, Any]) -> None:
        """Go on with a session that another replica gave up: the `info` of its answer to "export"."""
        self.require_ready()
        if self._copies is None or state["version"] != list(self.version):
            raise UnknownSession(f"session {session_id!r}: of another version of the policy; reset it")
        agent = self._copies.load(state["agent"])
        session = self.sessions.open(session_id)
        session.agent, session.steps = agent, state["steps"]

    def _prepare(self) -> None:
        self._agent.initialize()
        self.contract = self._agent.contract
        self._check(self.contract)
        self._copies = AgentCopies(self._agent)
        self._padding = Padding(self._batch_sizes, self._copies.make)
        self._copies.make()  # an agent that cannot be copied must fail now, not at the first reset

    def _run(self, batch: Sequence[Ticket]) -> None:
        """Answer every ticket of a batch. Runs on the policy's thread."""
        acting: list[tuple[Ticket, Session]] = []
        started = time.perf_counter()
        for ticket in batch:
            try:
                if ticket.request.op == "act":
                    acting.append((ticket, self._ready(ticket)))
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
                ticket.answer(Reply(ticket.request.request_id, error=self._explain(error, ticket)))
        if acting:
            self._act(acting, started)

    def _ready(self, ticket: Ticket) -> Session:
        session: Session = self.sessions.get(ticket.session_id)
        if session.agent is None:  # a reset ahead of it in the queue failed
            raise NotReset(f"session {ticket.session_id!r}: its last reset failed; reset again")
        step = ticket.request.step
        if step is not None and step != session.steps:
            raise UnknownSession(
                f"session {ticket.session_id!r}: has {session.steps} acts behind it here, {step} as its client "
                f"knows; an answer was lost: reset it"
            )
        return session

    def _export(self, ticket: Ticket) -> None:
        """Give the session up, to whoever asked: all that another replica needs to go on with it."""
        session = self.sessions.get(ticket.session_id)
        if session.agent is None or self._copies is None:
            raise UnknownSession(f"session {ticket.session_id!r}: not reset yet")
        state = {
            "agent": self._copies.dump(session.agent),
            "steps": session.steps,
            "version": list(self.version),
        }
        self.sessions.close(ticket.session_id)
        ticket.answer(Reply(ticket.request.request_id, info=state))

    def _observe(self, ticket: Ticket) -> None:
        session = self._ready(ticket)
        if session.agent is not None and ticket.request.obs is not None:  # `_ready` and the decoder have seen to both
            session.agent.observe(ticket.request.obs)
        ticket.request.obs = None
        ticket.answer(Reply(ticket.request.request_id, info={}))

    def _reset(self, ticket: Ticket) -> None:
        session = self.sessions.open(ticket.session_id, ticket.connection, ticket.transport, ticket.owner)
        session.agent = None
        session.steps = 0
        if self._copies is None or ticket.request.obs is None:  # start() and the decoder have seen to both
            raise PolicyFailed("reset without an initialized policy or an observation")
        begun = time.perf_counter()
        agent = self._copies.make()
        info = agent.reset(ticket.request.obs, ticket.request.instruction, **ticket.request.kwargs)
        if not isinstance(info, dict):
            raise PolicyFailed(f"reset: the policy returned {type(info).__name__}, want a dict")
        for obs in ticket.request.history:
            agent.observe(obs)
        reply = Reply(
            ticket.request.request_id, info=info, step=0, timing=_timing(ticket.arrived, begun, time.perf_counter())
        )
        _require_sendable(info)
        session.agent = agent
        self._padding.remember(ticket.request)
        ticket.request.obs, ticket.request.history = None, []
        ticket.answer(reply)

    def _act(self, acting: list[tuple[Ticket, Session]], started: float) -> None:
        observations = [ticket.request.obs for ticket, _ in acting]
        agents = [session.agent for _, session in acting]
        padding = self._padding.sessions(len(acting)) if self._batch_sizes else []
        observations += observations[-1:] * len(padding)
        rows = len(observations)
        begun = time.perf_counter()
        results: Sequence[Act | Exception]
        try:
            results = self._agent.act_batch(observations, agents + padding)  # type: ignore[arg-type]
            _synchronize()
            if len(results) != rows:
                raise PolicyFailed(f"act_batch: got {rows} observations, returned {len(results)} actions")
        except Exception as error:  # noqa: BLE001 - becomes the replies
            results = [error] * rows
        ended = time.perf_counter()
        del observations  # which may lie in memory that their sender wants back
        for ticket, _ in acting:
            ticket.request.obs = None
        self.stats.batch(len(acting), rows)
        if padding:
            self._padding.judge(results[len(acting) :])
            results = results[: len(acting)]
        hurries = self.queue.hurries()
        unsent = []
        for (ticket, session), result in zip(acting, results, strict=True):
            reply = self._answer(ticket, session, result)
            reply.timing = {**_timing(ticket.arrived, begun, ended), "batch_size": len(acting)}
            if hurries and ticket.rank is not Rank.ROBOT:
                unsent.append((ticket, reply))
            else:
                ticket.answer(reply)
        if unsent:
            self.queue.answer_later(unsent)

    def _answer(self, ticket: Ticket, session: Session, result: Act | Exception) -> Reply:
        request_id = ticket.request.request_id
        try:
            if isinstance(result, Exception):
                raise result
            if not isinstance(result, Act):
                raise PolicyFailed(f"act: the policy returned {type(result).__name__}, want an Act")
            act = Act(check_action(result.action, self.contract), bool(result.done), result.info)
            if act.info:
                _require_sendable(act.info)
        except Exception as error:  # noqa: BLE001 - becomes the reply
            return Reply(request_id, error=self._explain(error, ticket))
        session.steps += 1
        return Reply(request_id, act=act, step=session.steps)

    def _explain(self, error: Exception, ticket: Ticket) -> VLAgentsError:
        """The error as the caller may see it; what the policy itself raised stays in the log."""
        if isinstance(error, VLAgentsError):
            return error
        request = ticket.request
        logger.error(
            "%s failed (session %s, request %s)", request.op, ticket.session_id, request.request_id, exc_info=error
        )
        return PolicyFailed(
            f"{request.op}: the policy raised {type(error).__name__}; "
            f"the server's log has the details under request id {request.request_id or '(none)'}"
        )


def _timing(arrived: float, begun: float, ended: float) -> dict[str, Any]:
    return {"queue_ms": (begun - arrived) * 1e3, "inference_ms": (ended - begun) * 1e3}


def _require_sendable(info: dict[str, Any]) -> None:
    """An answer that cannot travel fails its own session, here, and nothing later; no array is copied for it."""
    try:
        Writer().value(info)
    except InvalidInput as error:
        raise PolicyFailed(f"the policy's answer cannot be sent: {error}") from error


def _synchronize() -> None:
    """Wait for the GPU, so that `inference_ms` is the truth."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        torch.cuda.synchronize()
