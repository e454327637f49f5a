"""One policy, its sessions and its batch queue: the core of a replica, without Ray.

Every door (HTTP, WebSocket, a Serve handle, …) turns what it receives into a `Request` and calls
`submit`; the reply comes back through a callback on the policy's thread.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from vlagents_ray.contract import Contract, check_action, check_observation, require_match
from vlagents_ray.errors import InvalidInput, NotReset, PolicyFailed, PolicyUnavailable, VLAgentsError
from vlagents_ray.interface import Act, Agent
from vlagents_ray.serve.batching import BatchQueue, Rank, Ticket
from vlagents_ray.serve.padding import Padding
from vlagents_ray.serve.sessions import AgentCopies, Session, SessionTable
from vlagents_ray.serve.stats import Stats
from vlagents_ray.wire.messages import Reply, Request
from vlagents_ray.wire.tree import Writer

logger = logging.getLogger(__name__)


class Engine:
    """Serves an agent to many sessions. `start` loads it; `close` ends it."""

    def __init__(
        self,
        agent: Agent,
        *,
        max_batch_size: int = 16,
        batch_sizes: Sequence[int] = (),
        session_limit: int = 1000,
        session_idle_s: float = 600.0,
    ) -> None:
        """With `batch_sizes` batches are padded up to the next of these; the largest is `max_batch_size`."""
        self._agent = agent
        self._copies: AgentCopies | None = None
        self._batch_sizes = batch_sizes
        self._padding = Padding((), lambda: agent)  # until the agent can be copied
        self.stats = Stats()
        self._unready: VLAgentsError | None = PolicyUnavailable("the policy is loading; try again")
        self.contract: Contract | None = None
        self.sessions = SessionTable(session_limit, session_idle_s)
        self.queue = BatchQueue(
            self._run, max_batch_size, prepare=self._prepare, idle=self.sessions.drop_idle, idle_s=session_idle_s / 10
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

    def require_ready(self) -> None:
        """Raise `PolicyUnavailable` while the policy loads, `PolicyFailed` if it could not or has died."""
        if self._unready is not None:
            raise self._unready
        if not self.queue.alive():
            raise PolicyFailed("the policy's thread has ended")

    def close(self) -> None:
        """Answer what waits with 503, finish the batch under way, close the agent."""
        self.queue.close(timeout_s=30)
        self._agent.close()

    def submit(
        self,
        session_id: str,
        request: Request,
        done: Callable[[Reply], None],
        rank: Rank = Rank.ROBOT,
        *,
        owner: str = "",
        transport: str = "",
    ) -> Ticket:
        """Queue a request whose answer goes to `done`. What is wrong with it is raised here, at once.

        `owner` is the connection, if it carries more than this session; owners take turns.
        """
        self.require_ready()
        if request.op == "act":
            if self.sessions.get(session_id).agent is None:
                raise NotReset(f"session {session_id!r}: act before a successful reset; reset first")
        elif request.op == "reset" and request.contract is not None:
            require_match(self.contract, Contract.from_json(request.contract))
        if request.obs is not None:
            check_observation(request.obs, self.contract)
        if request.op == "reset":
            self.sessions.open(session_id, transport)
        ticket = Ticket(session_id, request, done, rank, owner=owner, transport=transport)
        self.queue.put(ticket)
        return ticket

    def _prepare(self) -> None:
        self._agent.initialize()
        self.contract = self._agent.contract
        self._copies = AgentCopies(self._agent)
        self._padding = Padding(self._batch_sizes, self._copies.make)
        self._copies.make()  # an agent that cannot be copied must fail now, not at the first reset

    def _run(self, batch: Sequence[Ticket]) -> None:
        """Answer every ticket of a batch. Runs on the policy's thread."""
        acting: list[tuple[Ticket, Agent]] = []
        started = time.perf_counter()
        for ticket in batch:
            try:
                if ticket.request.op == "act":
                    acting.append((ticket, self._ready(ticket)))
                elif ticket.request.op == "reset":
                    self._reset(ticket)
                else:
                    self.sessions.close(ticket.session_id)
                    ticket.answer(Reply(ticket.request.request_id, info={}))
            except Exception as error:  # noqa: BLE001 - becomes the reply
                ticket.answer(Reply(ticket.request.request_id, error=self._explain(error, ticket)))
        if acting:
            self._act(acting, started)

    def _ready(self, ticket: Ticket) -> Agent:
        session: Session = self.sessions.get(ticket.session_id)
        if session.agent is None:  # a reset ahead of it in the queue failed
            raise NotReset(f"session {ticket.session_id!r}: its last reset failed; reset again")
        return session.agent

    def _reset(self, ticket: Ticket) -> None:
        session = self.sessions.open(ticket.session_id, ticket.transport)
        session.agent = None
        if self._copies is None or ticket.request.obs is None:  # start() and the decoder have seen to both
            raise PolicyFailed("reset without an initialized policy or an observation")
        begun = time.perf_counter()
        agent = self._copies.make()
        info = agent.reset(ticket.request.obs, ticket.request.instruction, **ticket.request.kwargs)
        if not isinstance(info, dict):
            raise PolicyFailed(f"reset: the policy returned {type(info).__name__}, want a dict")
        reply = Reply(ticket.request.request_id, info=info, timing=_timing(ticket.arrived, begun, time.perf_counter()))
        _require_sendable(info)
        session.agent = agent
        ticket.answer(reply)
        self._padding.remember(ticket.request)

    def _act(self, acting: list[tuple[Ticket, Agent]], started: float) -> None:
        observations = [ticket.request.obs for ticket, _ in acting]
        agents = [agent for _, agent in acting]
        padding = self._padding.sessions(len(acting)) if self._batch_sizes else []
        observations += observations[-1:] * len(padding)
        begun = time.perf_counter()
        results: Sequence[Act | Exception]
        try:
            results = self._agent.act_batch(observations, agents + padding)  # type: ignore[arg-type]
            _synchronize()
            if len(results) != len(observations):
                raise PolicyFailed(f"act_batch: got {len(observations)} observations, returned {len(results)} actions")
        except Exception as error:  # noqa: BLE001 - becomes the replies
            results = [error] * len(observations)
        ended = time.perf_counter()
        self.stats.batch(len(acting), len(observations))
        if padding:
            self._padding.judge(results[len(acting) :])
            results = results[: len(acting)]
        for (ticket, _), result in zip(acting, results, strict=True):
            reply = self._answer(ticket, result)
            reply.timing = {**_timing(ticket.arrived, begun, ended), "batch_size": len(acting)}
            ticket.answer(reply)

    def _answer(self, ticket: Ticket, result: Act | Exception) -> Reply:
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
        return Reply(request_id, act=act)

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
