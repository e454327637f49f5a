"""`RemoteAgent`: a policy on a server, used like a policy in this process."""

from __future__ import annotations

import copy
import math
import os
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from vlagents_ray.client.commands import CommandInbox
from vlagents_ray.client.connection import Connection
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.recovery import ClientSession, ResumePoint, call_with_recovery
from vlagents_ray.client.transports.base import CodecChoice, CodecName
from vlagents_ray.client.transports.select import TransportName, select_transport
from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    ConfigError,
    InvalidObservation,
    PolicyFailed,
)
from vlagents_ray.images.codecs import RAW, ImageCodec
from vlagents_ray.interface import DEADLINE, Act, Agent, Obs, copied
from vlagents_ray.protocol.messages import PRIORITIES, PriorityName, Reply, Request
from vlagents_ray.protocol.values import require_obs
from vlagents_ray.registry import require
from vlagents_ray.success import SuccessCurve, curves_in, weights_in
from vlagents_ray.tracing import TRACEPARENT, tracer

if TYPE_CHECKING:
    from typing_extensions import Self


class RemoteAgent(Agent):
    """A policy on a server, as an `Agent`; one object is one session.

    When the replica stops, crashes or has more sessions than other replicas, the session continues
    on another replica within `timeout_s`. If the old replica still runs, the session moves with all
    its state. Otherwise the client resumes the session with the same instruction and options, and
    sends the last `Contract.history` observations (see `Observes.observe`); `act.info["resumed"]`
    is then set. If the process of a replica is frozen, so that it answers no ping for 2 s, the
    client switches to another replica as soon as that replica answers. If a replica has not
    answered for 5 s in calls that reached their deadlines, the next call uses another replica, if
    any answers. The policy never computes two actions for the same observation.
    """

    statistics: dict[str, Any] | None = None
    """The ranges of the policy's training data, available after `initialize`; see
    `HasStatistics`.
    """

    def __init__(
        self,
        url: str,
        *,
        transport: TransportName = "auto",
        timeout_s: float = 30.0,
        connect_timeout_s: float | None = None,
        codec: ImageCodec | CodecName = "auto",
        priority: PriorityName = "robot",
        resume: bool = True,
        api_key: str | None = None,
        ca: str | os.PathLike[str] | None = None,
        certificate: tuple[str | os.PathLike[str], str | os.PathLike[str]] | None = None,
        commands: CommandInbox | None = None,
    ) -> None:
        """Set the server, without connecting; `initialize` or the first `reset` connects.

        Args:
            url: `http(s)://HOST:PORT[/APP]`, `ws(s)://…` or, inside a Ray cluster, `serve://APP`.
            transport: "auto" selects the fastest available transport: shared memory to a server of
                the same user on this machine, else a WebSocket; inside the cluster also a plasma
                channel to a replica on this node, else a Serve handle. The other values force a
                transport. `agent.transport` is the name of the transport in use.
            timeout_s: Time limit of a `reset` or `act`; an observation's `info["deadline_ms"]`
                shortens it for its `act`. 2 to 5 s suit a robot, since a call to a hanging policy
                lasts until this limit.
            connect_timeout_s: How long to wait for a server that cannot be reached or is still
                loading, by default `timeout_s`; after 2 s, a warning is logged.
            codec: The encoding of images for a network: "auto" is JPEG, which changes the pixels a
                little, and "exact" is PNG; to a server on this machine, both leave the pixels raw.
                "raw", "lossless" (PNG), "jpeg" or an `ImageCodec` force an encoding; "raw" is
                faster on a network of more than 300 MB/s (2.4 Gbit/s).
            priority: The priority of the requests: requests of a "robot" are answered before
                requests of a "simulation".
            resume: If False, the loss of a session raises `ConnectionLost`, and the episode needs a
                new `reset`.
            api_key: The API key, for a server that requires one; by default the value of
                `VLAGENTS_RAY_API_KEY`.
            ca: For `https://` and `wss://`: the PEM file with the certificates of the CAs that the
                client trusts; by default the CAs of the system.
            certificate: The PEM files of this client's certificate and its key, for a server that
                requires one.
            commands: Receives the commands from the live page to this agent's session; by default
                they are ignored.

        Raises:
            ConfigError: The URL has none of these forms, or does not fit the transport.
        """
        if priority not in PRIORITIES:
            raise ConfigError(f"priority: expected one of {list(PRIORITIES)}, got {priority!r}")

        choice = CodecChoice(codec)
        self.credentials = Credentials(api_key, ca, certificate)
        new_transport = partial(select_transport, url, transport, choice, self.credentials)

        connection = Connection(
            url,
            new_transport,
            choice,
            timeout_s,
            connect_timeout_s or timeout_s,
            leaves_silent=resume,
        )

        self._connection = connection
        self._commands = commands
        self._priority: PriorityName = priority
        self._resume = resume
        self._session = ClientSession(connection, priority)
        self._tracer = tracer()

    def sessions(self, n: int) -> list[Self]:
        """Open `n` more sessions on this agent's connection, for `reset_batch` and `act_batch`; the
        caller closes each of them.
        """
        agents = [copy.copy(self) for _ in range(n)]
        for agent in agents:
            agent._commands = None
            agent._session = ClientSession(self._connection, self._priority)
        return agents

    @property
    def url(self) -> str:
        """The server's URL, as passed to the constructor."""
        return self._connection.url

    @property
    def session(self) -> str:
        """The id of the session; it changes after `close`, and when an episode is resumed on
        another replica.
        """
        return self._session.id

    @property
    def transport(self) -> str:
        """The transport of the requests: "shm", "plasma", "websocket", "http" or "handle";
        "auto" until connected.
        """
        return self._connection.transport.name

    @property
    def codec(self) -> ImageCodec | None:
        """The codec of the camera images; None before the agent has connected."""
        if self.transport in ("shm", "plasma", "handle"):
            return RAW
        return self._connection.codec.codec

    @property
    def reconnects(self) -> int:
        """The number of reconnections after lost connections or at the server's request."""
        return self._connection.reconnects

    @property
    def metadata(self) -> dict[str, Any]:
        """The server's metadata: policy, checkpoint, contract, protocol version."""
        self._connection.open()
        return dict(self._connection.metadata or {})

    @property
    def contract(self) -> Contract | None:
        """The policy's side of the contract; None if the policy has none."""
        self._connection.open()
        return self._connection.contract

    def initialize(self) -> None:
        """Connect, waiting for the server to become ready.

        Raises:
            PolicyUnavailable: The server does not become ready.
            MalformedMessage: The server's metadata contain a value of the wrong type.
        """
        self._connection.open()
        self.statistics = weights_in(self.metadata).get("statistics")

    def reset(
        self,
        obs: Obs,
        instruction: str | None = None,
        *,
        contract: Contract | dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """Begin an episode; `kwargs` are passed to the policy's `reset`.

        The returned info contains the name of the policy's checkpoint. If `contract`, the contract
        of the robot or the environment, is given, the server first compares it with the policy's
        contract. `ContractMismatch` then lists every difference.
        """
        [info] = self.reset_batch([obs], [instruction], [self], contract=contract, **kwargs)
        if isinstance(info, Exception):
            raise info
        if self._commands is not None:
            self._commands.begin_episode()
        return info

    def reset_batch(
        self,
        obs: Sequence[Obs],
        instructions: Sequence[str | None],
        sessions: Sequence[RemoteAgent],
        *,
        contract: Contract | dict[str, Any] | None = None,
        seeds: Sequence[int] | None = None,
        **kwargs: Any,
    ) -> list[dict[str, Any] | Exception]:
        """Begin episodes of several sessions of this connection in one message.

        Args:
            obs: The first observation of each session.
            instructions: The instruction of each session.
            sessions: Agents returned by `sessions` of this agent, or this agent itself.
            contract: The contract of the robot or the environment, as in `reset`.
            seeds: The option `seed` for the reset of each session, if the seeds differ.
            kwargs: Options of the policy's `reset`, the same for all sessions.

        Returns:
            The result of `reset` for each session, or its exception, which affects only that
            session.
        """
        client_sessions = self._client_sessions(sessions)
        for first_obs in obs:
            require_obs(first_obs)
        self._connection.open()

        contract_json = contract.to_json() if isinstance(contract, Contract) else contract
        policy_contract = self._connection.contract
        history = (policy_contract.history if policy_contract else None) or 1
        if seeds is None:
            options_of_sessions = [kwargs] * len(client_sessions)
        else:
            options_of_sessions = [{**kwargs, "seed": seed} for seed in seeds]

        episodes = []
        for first_obs, instruction, options in zip(
            obs, instructions, options_of_sessions, strict=True
        ):
            episode_obs = copied(first_obs) if self._resume else first_obs
            recent: deque[Obs] = deque(maxlen=history - 1)
            episodes.append(ResumePoint(episode_obs, instruction, options, contract_json, recent))

        for session in client_sessions:
            session.episode = None
        requests = [
            session.reset(episode)
            for session, episode in zip(client_sessions, episodes, strict=True)
        ]
        replies = self._call(client_sessions, requests, self._connection.timeout_s)

        infos: list[dict[str, Any] | Exception] = []
        for session, episode, reply in zip(client_sessions, episodes, replies, strict=True):
            if reply.error is None:
                session.episode = episode
                session.resumed = False
                session.begun(reply)
                self._connection.users.add(session)
            infos.append(reply.error or reply.info or {})
        return infos

    def act(self, obs: Obs) -> Act:
        """Return the next action, (D,) float32, or chunk of actions, (H, D).

        `act.info["timing"]` contains the duration of each stage in milliseconds. The server starts
        to measure when it has received the last byte of the request: `decode_ms`, `queue_ms`,
        `inference_ms` (until the device has finished), `encode_ms`, and `total_ms`, which also
        includes the time between these stages. The client adds `round_trip_ms` and `wire_ms`, which
        is `round_trip_ms` minus `total_ms`: encoding and decoding by the client, the network, and
        proxies. `timing` also contains `batch_size`, the number of requests in the batch.
        """
        commands = self._commands
        require_obs(obs)
        [act] = self.act_batch([obs if commands is None else commands.with_outcomes(obs)], [self])
        if commands is not None:
            commands.receive(act)
        if isinstance(act, Exception):
            raise act
        return act

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Return one action for each of several sessions of this connection, with one message in
        each direction.

            envs = agent.sessions(16)
            agent.reset_batch(observations, ["pick up the cube"] * 16, envs)
            acts = agent.act_batch(observations, envs)

        The server computes the actions in as few batches as its batch limit allows. An exception in
        the returned list affects only the session at its index.
        """
        begun = time.perf_counter()
        client_sessions = self._client_sessions(sessions)
        if len(obs) != len(client_sessions):
            raise ConfigError(
                f"act_batch: expected {len(client_sessions)} observations, one for each session, "
                f"got {len(obs)}"
            )
        for session_obs in obs:
            require_obs(session_obs)

        requests = [
            session.act(session_obs)
            for session, session_obs in zip(client_sessions, obs, strict=True)
        ]
        timeout_s = min(self._connection.timeout_s, _deadline_s(obs))
        replies = self._call(client_sessions, requests, timeout_s)

        round_trip_ms = (time.perf_counter() - begun) * 1e3
        return [
            self._read_reply(session, session_obs, reply, round_trip_ms)
            for session, session_obs, reply in zip(client_sessions, obs, replies, strict=True)
        ]

    @property
    def continues_plans(self) -> bool:
        """Whether the policy's chunks continue the executed plan; see `ContinuesPlans`."""
        return bool((self.metadata or {}).get("continues_plans"))

    @property
    def longest_prefix(self) -> int:
        """The largest number of rows of the executed plan with which a chunk begins; see
        `BeginsWithPlan`.
        """
        rows = (self.metadata or {}).get("longest_prefix")
        return rows if type(rows) is int and rows > 0 else 0

    @property
    def success_curves(self) -> Sequence[SuccessCurve]:
        """The measured success of the policy's checkpoint; see `HasSuccess`.

        Raises:
            MalformedMessage: The server's metadata contain no curves there.
        """
        return curves_in(self.metadata)

    def close(self) -> None:
        """End the session. A later `reset` begins a new session."""
        self._connection.end_session(self._session, self._session.id)
        self._session = ClientSession(self._connection, self._priority)

    def _client_sessions(self, sessions: Sequence[Agent]) -> list[ClientSession]:
        """Return the sessions of these agents; raise `ConfigError` unless all share this
        connection.
        """
        client_sessions: list[ClientSession] = []
        for agent in sessions:
            if not isinstance(agent, RemoteAgent) or agent._connection is not self._connection:
                raise ConfigError(
                    "sessions: expected agents made by sessions() of this agent, which share its "
                    "connection, got other agents; make them with sessions()"
                )
            client_sessions.append(agent._session)
        return client_sessions

    def _call(
        self, sessions: Sequence[ClientSession], requests: Sequence[Request], timeout_s: float
    ) -> list[Reply]:
        """Return the replies to these requests, within a span if the process traces them."""
        call = (
            partial(call_with_recovery, self._connection, sessions)
            if self._resume
            else self._connection.call
        )
        if self._tracer is None:
            return call(requests, timeout_s)

        # The span is a child of the caller's span, if there is one, and the parent of the server's
        # span.
        trace: Any = require("opentelemetry.trace", extra="otel")
        context: Any = require("opentelemetry.trace.propagation.tracecontext", extra="otel")
        name = f"vlagents {requests[0].op}"
        attributes = {
            "server.url": self.url,
            "transport": self.transport,
            "requests": len(requests),
        }
        with self._tracer.start_as_current_span(
            name, kind=trace.SpanKind.CLIENT, attributes=attributes
        ) as span:
            carrier: dict[str, str] = {}
            context.TraceContextTextMapPropagator().inject(carrier)
            for request in requests:
                if request.obs is not None:
                    info = {**request.obs.info, TRACEPARENT: carrier[TRACEPARENT]}
                    request.obs = replace(request.obs, info=info)

            replies = call(requests, timeout_s)
            errors = [reply.error for reply in replies if reply.error is not None]
            if errors:
                span.set_status(trace.StatusCode.ERROR, f"{errors[0].code}: {errors[0]}")
            return replies

    def _read_reply(
        self, session: ClientSession, obs: Obs, reply: Reply, round_trip_ms: float
    ) -> Act | Exception:
        """Update a session with the reply to its `act`, and return the action or the error."""
        episode = session.episode
        if reply.error is not None or reply.act is None or episode is None:
            session.failed(reply.error, resumes=self._resume)
            return reply.error or PolicyFailed("act: the server's reply contains no action")

        session.begun(reply)
        if episode.recent.maxlen:
            episode.recent.append(copied(obs))

        timing = reply.act.info["timing"] = reply.timing
        timing["round_trip_ms"] = round_trip_ms
        if "total_ms" in timing:
            timing["wire_ms"] = round_trip_ms - timing["total_ms"]
        return reply.act


def _deadline_s(obs: Sequence[Obs]) -> float:
    """Return the time, s, until the earliest deadline of the observations."""
    deadlines_ms = [session.info[DEADLINE] for session in obs if DEADLINE in session.info]
    for deadline_ms in deadlines_ms:
        if not isinstance(deadline_ms, (int, float)) or not deadline_ms > 0:
            raise InvalidObservation(
                f"info[{DEADLINE!r}]: expected milliseconds above 0, got {deadline_ms!r}"
            )
    return min(deadlines_ms, default=math.inf) / 1e3
