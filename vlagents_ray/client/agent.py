"""RemoteAgent: a policy somewhere else, used like one in this process."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from vlagents_ray.client.connection import Connection
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.link import CodecChoice, Link, Wish
from vlagents_ray.client.session import Episode, Session, copied, persist
from vlagents_ray.client.ways import TransportName, choose
from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    ConfigError,
    ConnectionLost,
    DeadlineExceeded,
    InvalidObservation,
    PolicyFailed,
    UnknownSession,
)
from vlagents_ray.interface import DEADLINE, Act, Agent, Obs
from vlagents_ray.wire.codecs import RAW, ImageCodec
from vlagents_ray.wire.messages import RANKS, RankName, Reply, Request

if TYPE_CHECKING:
    from typing_extensions import Self


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
    `api_key` is for a server that asks for one; by default it is what `VLAGENTS_RAY_API_KEY` holds. With
    `https://` and `wss://`, `ca` is a PEM file of those who may have signed the server's certificate, where that
    is not one of the system's, and `certificate` the files of this client's own certificate and its key, for a
    server that wants to see one.
    `rank` is the class of its requests: a "robot" goes before a "simulation".

    `connect_timeout_s` is how long `initialize` (called by the first `reset`) waits for a server
    that is still loading; `timeout_s` is how long a `reset` or `act` may take; an observation's
    `info["deadline_ms"]` allows its `act` less.

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
        api_key: str | None = None,
        ca: str | os.PathLike[str] | None = None,
        certificate: tuple[str | os.PathLike[str], str | os.PathLike[str]] | None = None,
    ) -> None:
        if rank not in RANKS:
            raise ConfigError(f"rank: got {rank!r}, want one of {list(RANKS)}")
        choice = CodecChoice(codec)
        way = choose(url, transport, choice, Credentials(api_key, ca, certificate))
        self._join(Connection(url, way, choice, timeout_s, connect_timeout_s), rank, resume)

    def _join(self, connection: Connection, rank: RankName, resume: bool) -> None:
        self._connection = connection
        self._rank: RankName = rank
        self._resume = resume
        self._session = Session(connection, rank)

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

        `checkpoint` and `checkpoint_step` do not: they choose among what the server offers (`metadata["checkpoints"]`),
        and the info that is returned says which it is.

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
        siblings = self._siblings(sessions)
        self._connection.open()
        stated = contract.to_json() if isinstance(contract, Contract) else contract
        history = (self._connection.contract.history if self._connection.contract else None) or 1
        episodes = [
            Episode(copied(first) if self._resume else first, text, kwargs, stated, deque(maxlen=history - 1))
            for first, text in zip(obs, instructions, strict=True)
        ]
        for session in siblings:
            session.episode = None
        requests = [session.reset(episode) for session, episode in zip(siblings, episodes, strict=True)]
        replies = self._call(siblings, requests, self._connection.timeout_s)
        infos: list[dict[str, Any] | Exception] = []
        for session, episode, reply in zip(siblings, episodes, replies, strict=True):
            if reply.error is None:
                session.episode = episode
                self._connection.users.add(session)
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
        siblings = self._siblings(sessions)
        if len(obs) != len(siblings):
            raise ConfigError(f"act_batch: got {len(obs)} observations for {len(siblings)} sessions")
        requests = [session.act(one) for session, one in zip(siblings, obs, strict=True)]
        replies = self._call(siblings, requests, min(self._connection.timeout_s, _deadline_s(obs)))
        round_trip_ms = (time.perf_counter() - begun) * 1e3
        return [self._take(*each, round_trip_ms) for each in zip(siblings, obs, replies, strict=True)]

    def close(self) -> None:
        """End the session. A later `reset` begins another."""
        self._connection.leave(self._session, self._session.id)
        self._session = Session(self._connection, self._rank)

    def _siblings(self, sessions: Sequence[Agent]) -> list[Session]:
        found: list[Session] = []
        for agent in sessions:
            if not isinstance(agent, RemoteAgent) or agent._connection is not self._connection:
                raise ConfigError("sessions: want agents made by sessions() of this one, which share its connection")
            found.append(agent._session)
        return found

    def _call(self, sessions: Sequence[Session], requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        if self._resume:
            return persist(self._connection, sessions, requests, timeout_s)
        return self._connection.call(requests, timeout_s)

    def _take(self, session: Session, obs: Obs, reply: Reply, round_trip_ms: float) -> Act | Exception:
        episode = session.episode
        if reply.error is not None or reply.act is None or episode is None:
            if isinstance(reply.error, DeadlineExceeded) and episode is not None:
                episode.step = None  # it may have been acted on
            elif isinstance(reply.error, (ConnectionLost, UnknownSession)) and not self._resume:
                session.episode = None
            return reply.error or PolicyFailed("act: the server's reply holds no action")
        episode.acted(obs, reply.step)
        timing = reply.act.info["timing"] = {**reply.timing, "round_trip_ms": round_trip_ms}
        if "total_ms" in timing:
            timing["wire_ms"] = round_trip_ms - timing["total_ms"]
        return reply.act


def _deadline_s(obs: Sequence[Obs]) -> float:
    """After how long the sender of the most urgent of the observations wants no answer any more."""
    soonest_ms = math.inf
    for one in obs:
        if DEADLINE in one.info:
            value = one.info[DEADLINE]
            if not isinstance(value, (int, float)) or not value > 0:
                raise InvalidObservation(f"info[{DEADLINE!r}]: got {value!r}, want milliseconds above 0")
            soonest_ms = min(soonest_ms, value)
    return soonest_ms / 1e3
