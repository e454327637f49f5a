"""RemoteAgent: a policy somewhere else, used like one in this process."""

from __future__ import annotations

import time
import uuid
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from vlagents_ray.client.connection import Connection
from vlagents_ray.client.episode import Episode, copied
from vlagents_ray.client.link import CodecChoice, Link, Wish
from vlagents_ray.client.ways import TransportName, choose
from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    ConfigError,
    ConnectionLost,
    DeadlineExceeded,
    NotReset,
    PolicyFailed,
    PolicyUnavailable,
    UnknownSession,
)
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.wire.codecs import RAW, ImageCodec
from vlagents_ray.wire.messages import RANKS, RankName, Reply, Request

if TYPE_CHECKING:
    from typing_extensions import Self


_GONE = (ConnectionLost, PolicyUnavailable, UnknownSession)  # the session may go on elsewhere
_FIRST_PAUSE_S = 0.02
_LONGEST_PAUSE_S = 0.5


class RemoteAgent(Agent):
    """A policy on a server, as an `Agent`; one object is one session.

    `url` is `http(s)://HOST:PORT[/APP]`, `ws(s)://…` or, inside a Ray cluster, `serve://APP`.
    `transport` "auto" takes the fastest that there is: shared memory to a server of the same user on
    this machine, else a WebSocket; inside the cluster a plasma channel to a replica on this node, else
    a Serve handle. `agent.transport` says which, once connected.
    Over a network, `codec` "auto" measures the link when the first images are sent (0.3 s at most,
    unless ten round trips take longer) and writes them as raw pixels, JPEG or PNG, whichever is the
    fastest to encode, send and decode; "exact" leaves out JPEG, which changes the pixels a little;
    "raw", "lossless" (PNG), "jpeg" or an `ImageCodec` with quality and subsampling force one.
    `agent.codec` says which is used, `agent.link` what was measured. Shared memory, plasma and the
    handle carry raw pixels.
    `rank` is the class of its requests: a "robot" goes before a "simulation".

    `connect_timeout_s` is how long `initialize` (called by the first `reset`) waits for a server
    that is still loading; `timeout_s` is how long a `reset` or `act` may take.

    When the replica stops, dies or has more sessions than others, the session goes on at another one within
    `timeout_s`: moved with all its state if the old replica still lives, else begun again with the same
    instruction and options and shown the last observations (`Contract.history` of them; see `Agent.observe`).
    `act.info["resumed"]` says that the latter happened. No observation is ever acted on twice by one session.
    With `resume=False` the loss is raised as `ConnectionLost` instead, and the episode needs a new `reset`.
    """

    def __init__(
        self,
        url: str,
        *,
        transport: TransportName = "auto",
        timeout_s: float = 30.0,
        connect_timeout_s: float = 60.0,
        codec: ImageCodec | Wish = "auto",
        rank: RankName = "robot",
        resume: bool = True,
    ) -> None:
        if rank not in RANKS:
            raise ConfigError(f"rank: got {rank!r}, want one of {list(RANKS)}")
        choice = CodecChoice(codec)
        way = choose(url, transport, choice)
        self._join(Connection(url, way, choice, timeout_s, connect_timeout_s), rank, resume)

    def _join(self, connection: Connection, rank: RankName, resume: bool) -> None:
        self._connection = connection
        self._rank: RankName = rank
        self._resume = resume
        self._session = uuid.uuid4().hex
        self._episode: Episode | None = None

    def sessions(self, n: int) -> list[Self]:
        """`n` more sessions on this one's connection, for `reset_batch` and `act_batch`; each to be closed."""
        made = []
        for _ in range(n):
            agent = object.__new__(type(self))
            agent._join(self._connection, self._rank, self._resume)
            made.append(agent)
        return made

    @property
    def url(self) -> str:
        """As it was given."""
        return self._connection.url

    @property
    def transport(self) -> str:
        """What carries the requests: "shm", "plasma", "websocket", "http" or "handle"; "auto" until connected."""
        return self._connection.transport.name

    @property
    def codec(self) -> ImageCodec | None:
        """How cameras are written; None until the first images call for a choice."""
        return RAW if self.transport in ("shm", "plasma", "handle") else self._connection.codec.codec

    @property
    def link(self) -> Link | None:
        """Round trip (s) and bandwidth (bytes/s) to the server; None unless they were measured to choose a codec."""
        return self._connection.codec.link

    @property
    def metadata(self) -> dict[str, Any]:
        """What the server says of itself: policy, checkpoint, contract, protocol version."""
        self._connection.open()
        return dict(self._connection.metadata or {})

    @property
    def contract(self) -> Contract | None:
        """The policy's side of the contract; None if it states none."""
        self._connection.open()
        return self._connection.contract

    def initialize(self) -> None:
        """Connect, waiting for the server to become ready; `PolicyUnavailable` if it does not."""
        self._connection.open()

    def reset(
        self,
        obs: Obs,
        instruction: str | None = None,
        *,
        contract: Contract | dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """Begin an episode; `kwargs` reach the policy's `reset`.

        With `contract`, the robot's or env's side, the server compares it with the policy's first
        and raises `ContractMismatch` with every difference.
        """
        [info] = self.reset_batch([obs], [instruction], [self], contract=contract, **kwargs)
        if isinstance(info, Exception):
            raise info
        return info

    def reset_batch(
        self,
        obs: Sequence[Obs],
        instructions: Sequence[str | None],
        sessions: Sequence[RemoteAgent],
        *,
        contract: Contract | dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> list[dict[str, Any] | Exception]:
        """`reset` of several sessions of this connection in one message; an exception stands for its own alone."""
        self._require_siblings(sessions)
        self._connection.open()
        stated = contract.to_json() if isinstance(contract, Contract) else contract
        history = (self._connection.contract.history if self._connection.contract else None) or 1
        episodes = [
            Episode(copied(first) if self._resume else first, text, kwargs, stated, deque(maxlen=history - 1))
            for first, text in zip(obs, instructions, strict=True)
        ]
        for agent in sessions:
            agent._episode = None
        requests = [agent._reset_request(episode) for agent, episode in zip(sessions, episodes, strict=True)]
        replies = self._persist(sessions, requests)
        infos: list[dict[str, Any] | Exception] = []
        for agent, episode, reply in zip(sessions, episodes, replies, strict=True):
            if reply.error is None:
                agent._episode = episode
                self._connection.users.add(agent)
            infos.append(reply.error or reply.info or {})
        return infos

    def act(self, obs: Obs) -> Act:
        """The next action, (D,) float32, or chunk of actions, (H, D).

        `act.info["timing"]` holds milliseconds by stage: on the server, from the last byte of the
        request, `decode_ms`, `queue_ms`, `inference_ms` (until the device is done), `encode_ms` and
        `total_ms`, which is the sum and what lies between; here `round_trip_ms` and, as the rest of
        it, `wire_ms`: this side's coding, the network, proxies. `batch_size` is no time.
        """
        [act] = self.act_batch([obs], [self])
        if isinstance(act, Exception):
            raise act
        return act

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """One action for each of several sessions of this connection, in one message each way.

            envs = agent.sessions(16)
            agent.reset_batch(observations, ["pick up the cube"] * 16, envs)
            acts = agent.act_batch(observations, envs)

        The server runs them in as few batches as its limit allows. An exception in place of an
        action is that of its session alone.
        """
        begun = time.perf_counter()
        agents = self._require_siblings(sessions)
        if len(obs) != len(agents):
            raise ConfigError(f"act_batch: got {len(obs)} observations for {len(agents)} sessions")
        for agent in agents:
            if agent._episode is None:
                raise NotReset("act before reset: this agent has no session, or lost it; reset first")
        replies = self._persist(agents, [agent._act_request(one) for agent, one in zip(agents, obs, strict=True)])
        round_trip_ms = (time.perf_counter() - begun) * 1e3
        return [agent._take(one, reply, round_trip_ms) for agent, one, reply in zip(agents, obs, replies, strict=True)]

    def close(self) -> None:
        """End the session. A later `reset` begins another."""
        self._connection.leave(self, self._session)
        self._episode = None
        self._session = uuid.uuid4().hex

    def _require_siblings(self, sessions: Sequence[Agent]) -> list[RemoteAgent]:
        found: list[RemoteAgent] = []
        for agent in sessions:
            if not isinstance(agent, RemoteAgent) or agent._connection is not self._connection:
                raise ConfigError("sessions: want agents made by sessions() of this one, which share its connection")
            found.append(agent)
        return found

    def _reset_request(self, episode: Episode) -> Request:
        return Request(
            "reset",
            episode.obs,
            episode.instruction,
            episode.kwargs,
            episode.contract,
            history=list(episode.recent),
            session=self._session,
            rank=self._rank,
            request_id=self._connection.request_id(),
        )

    def _act_request(self, obs: Obs) -> Request:
        step = self._episode.step if self._episode is not None else None
        request_id = self._connection.request_id()
        return Request("act", obs, session=self._session, rank=self._rank, step=step, request_id=request_id)

    def _take(self, obs: Obs, reply: Reply, round_trip_ms: float) -> Act | Exception:
        episode = self._episode
        if reply.error is not None or reply.act is None or episode is None:
            if isinstance(reply.error, DeadlineExceeded) and episode is not None:
                episode.step = None  # it may have been acted on
            elif isinstance(reply.error, (ConnectionLost, UnknownSession)) and not self._resume:
                self._episode = None
            return reply.error or PolicyFailed("act: the server's reply holds no action")
        episode.acted(obs, reply.step)
        timing = reply.act.info["timing"] = {**reply.timing, "round_trip_ms": round_trip_ms}
        if "total_ms" in timing:
            timing["wire_ms"] = round_trip_ms - timing["total_ms"]
        return reply.act

    def _persist(self, agents: Sequence[RemoteAgent], requests: Sequence[Request]) -> list[Reply]:
        """The replies to requests of these sessions, from another replica if theirs is gone."""
        connection = self._connection
        deadline = time.monotonic() + connection.timeout_s
        replies = connection.call(requests, connection.timeout_s)
        lost: set[int] = set()  # whose state no replica has
        resumed: set[int] = set()
        pause_s = 0.0
        while self._resume and (gone := [i for i, reply in enumerate(replies) if _may_go_on(requests[i], reply)]):
            if time.monotonic() + pause_s >= deadline:
                break
            time.sleep(pause_s)
            pause_s = min(_LONGEST_PAUSE_S, 2 * pause_s + _FIRST_PAUSE_S)
            lost |= {i for i in gone if requests[i].op == "act" and agents[i]._is_lost(replies[i])}
            if again := [i for i in gone if i in lost]:
                resets = [agents[i]._begin_again(requests[i]) for i in again]
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

    def _is_lost(self, reply: Reply) -> bool:
        """Must the session begin again? If not, the replica that has it checks that no answer was lost."""
        return isinstance(reply.error, UnknownSession) or self._episode is None or self._episode.step is None

    def _begin_again(self, request: Request) -> Request:
        """Under another name, lest what is left of the old session is met; `request` is what comes after."""
        if self._episode is None:  # act_batch has looked
            raise NotReset("act before reset; reset first")
        self._session = request.session = uuid.uuid4().hex
        self._episode.step = request.step = 0
        return self._reset_request(self._episode)


def _may_go_on(request: Request, reply: Reply) -> bool:
    """Is this an answer that a living replica would not give? A reset that is refused, as by a full one, stays so."""
    return isinstance(reply.error, ConnectionLost if request.op == "reset" else _GONE)
