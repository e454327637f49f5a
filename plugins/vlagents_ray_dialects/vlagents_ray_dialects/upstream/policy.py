"""Another policy server's model as a policy: its settings, and the policy itself."""

from __future__ import annotations

import os
import time
import uuid
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal
from urllib.parse import urlsplit

from pydantic import BaseModel, Field, field_validator, model_validator
from typing_extensions import Self

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, ContractMismatch, NotReset, VLAgentsError
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.outcomes import attempt, compute_valid
from vlagents_ray.serve.config.dialects import read_mapping
from vlagents_ray.wire.mapping import KeyMapping
from vlagents_ray_dialects.messages.outgoing import Outgoing
from vlagents_ray_dialects.upstream.client import ClientOptions, UpstreamClient
from vlagents_ray_dialects.upstream.connections import Lanes, SessionConnections
from vlagents_ray_dialects.upstream.gr00t import GR00TClient
from vlagents_ray_dialects.upstream.http import FlashRTClient, OpenVLAClient, SGLangClient
from vlagents_ray_dialects.upstream.vlagents import VlagentsClient
from vlagents_ray_dialects.upstream.websocket import (
    OpenPiBatchClient,
    OpenPiClient,
    RoboArenaClient,
    VlaEvalClient,
)

PROTOCOLS: dict[str, type[UpstreamClient]] = {
    "openpi": OpenPiClient,
    "openpi-batch": OpenPiBatchClient,
    "roboarena": RoboArenaClient,
    "gr00t": GR00TClient,
    "openvla": OpenVLAClient,
    "vla_eval": VlaEvalClient,
    "vlagents": VlagentsClient,
    "sglang": SGLangClient,
    "flashrt": FlashRTClient,
}


class UpstreamConfig(BaseModel, extra="forbid"):
    """The address, protocol and time limits of the other policy server."""

    protocol: Literal[
        "openpi",
        "openpi-batch",
        "roboarena",
        "gr00t",
        "openvla",
        "vla_eval",
        "vlagents",
        "sglang",
        "flashrt",
    ]
    urls: list[str] = Field(
        min_length=1,
        max_length=64,
        description="of servers with the same model, e.g. ws://gpu-box:8000, tcp://gpu-box:5555 "
        "(gr00t), "
        "http://gpu-box:8000 (openvla, sglang, flashrt); a batch is spread over them",
    )
    mapping: str | dict[str, Any] | None = Field(
        default=None,
        description="our names of the upstream's keys: a preset's name, or an object, as for "
        "dialects; default: the "
        "protocol's own, except for openpi, whose robots have different keys",
    )
    contract: dict[str, Any] = Field(
        default_factory=dict,
        description="what is known about the model beyond the mapping, e.g. action: {dim: 7}, "
        "chunk",
    )
    sessions: Literal["none", "connection"] | None = Field(
        default=None,
        description="none: the model keeps nothing between two observations, and connections are "
        "shared; connection: a "
        "session has a connection of its own, and is reset; default: connection for roboarena and "
        "vla_eval",
    )
    connections: int = Field(
        default=1,
        ge=1,
        le=64,
        description="to each URL, over which a batch is spread too; for `sessions: none`",
    )
    timeout_s: float = Field(
        default=30.0, gt=0, description="for an answer; then the connection counts as lost, s"
    )
    retry_s: float = Field(
        default=2.0,
        ge=0,
        description="for a lost upstream to return, before a request is answered with 503, s",
    )
    connect_timeout_s: float = Field(
        default=600.0, gt=0, description="for the first upstream to answer at the start, s"
    )
    key_env: str | None = Field(
        default=None, description="name of the environment variable with the upstream's API key"
    )

    @field_validator("contract")
    @classmethod
    def _readable(cls, value: dict[str, Any]) -> dict[str, Any]:
        try:
            Contract.from_json(value)
        except VLAgentsError as error:
            raise ValueError(str(error)) from error
        return value

    @model_validator(mode="after")
    def _fit(self) -> Self:
        for url in self.urls:
            parts = urlsplit(url)
            if parts.scheme not in self.client.schemes or not parts.hostname:
                want = " or ".join(f"{scheme}://HOST:PORT" for scheme in self.client.schemes)
                raise ValueError(f"urls: got {url!r}, want {want} for {self.protocol}")
            if parts.username is not None or parts.password is not None:
                raise ValueError(
                    "urls: got a name or a password in one; put the key into a variable, and name "
                    "it in key_env"
                )
        if self.key_env is not None and not self.client.takes_key:
            raise ValueError(f"key_env: {self.protocol} has no place for a key; remove it")
        if self.mapping is None and self.client.mapping is None:
            raise ValueError(
                f"mapping: {self.protocol} has none of its own; give an object, or a preset, such "
                "as openpi-libero for openpi"
            )
        self.keys()  # raises an error for an invalid mapping
        return self

    @property
    def client(self) -> type[UpstreamClient]:
        return PROTOCOLS[self.protocol]

    @property
    def keeps_sessions(self) -> bool:
        """Whether each session has its own connection."""
        return (
            self.client.keeps_sessions if self.sessions is None else self.sessions == "connection"
        )

    def keys(self) -> KeyMapping:
        return read_mapping(self.mapping if self.mapping is not None else str(self.client.mapping))


UPSTREAM_MS = "upstream_ms"  # in `Act.info`: the time that the upstreams needed for the batch, ms


class Upstream(Agent):
    """Requests the actions of each batch from the servers of another system.

    The mapping converts the observation to the upstream's own keys. The upstream's actions are
    returned unchanged; the contract states the range of their gripper commands.
    """

    Config: ClassVar[type] = UpstreamConfig
    shared: ClassVar[tuple[str, ...]] = ("config", "_outgoing", "_lanes", "_sessions", "_state")

    def __init__(self, config: UpstreamConfig) -> None:
        self.config = config
        client = config.client
        self._outgoing = Outgoing(config.keys(), client.is_nested, client.text_key)
        self._state = {"contract": _contract(self._outgoing.contract(), config.contract)}
        self._lanes: Lanes | None = None
        self._sessions: SessionConnections | None = None
        self._session: str | None = None
        self._instruction: str | None = None

    @property
    def contract(self) -> Contract:
        """The contract from the mapping and the settings, with the length of a chunk if the
        upstream states it.
        """
        return self._state["contract"]

    def initialize(self) -> None:
        """Connect to the upstreams; raises `ContractMismatch` if their metadata contradicts the
        mapping.
        """
        config, key = self.config, None
        if config.key_env is not None:
            key = os.environ.get(config.key_env)
            if not key:
                raise ConfigError(
                    f"key_env: the environment variable {config.key_env!r} is not set; set it "
                    "where the replica runs"
                )

        def make(url: str) -> UpstreamClient:
            return config.client(ClientOptions(url, config.timeout_s, key))

        if config.keeps_sessions:
            self._sessions = SessionConnections(config.urls, make, self._check, config.retry_s)
            self._sessions.start(config.connect_timeout_s)
        else:
            clients = [make(url) for _ in range(config.connections) for url in config.urls]
            self._lanes = Lanes(clients, self._check, config.retry_s)
            self._lanes.start(config.connect_timeout_s)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode, also at the upstream if that keeps sessions."""
        self._instruction = instruction
        if self._sessions is not None:
            self._session = uuid.uuid4().hex
            self._sessions.begin(self._session)
            # The copy ends with its session.
            ended = weakref.finalize(self, self._sessions.drop, self._session)
            ended.atexit = False
        return {}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Request the actions of all sessions from the upstreams at once; an error only fails
        its own session.
        """

        def converted(one: Obs, session: Any) -> tuple[Any, dict[str, Any]]:
            return session, self._outgoing.observation(one, session._instruction)

        def ask(good: list[tuple[Any, dict[str, Any]]]) -> list[Any]:
            begun = time.perf_counter()
            answers = self._ask(*zip(*good, strict=True))
            info = {UPSTREAM_MS: (time.perf_counter() - begun) * 1e3}

            def act(answer: Any) -> Any:
                return (
                    answer
                    if isinstance(answer, Exception)
                    else Act(self._outgoing.rows(answer), info=info)
                )

            return [attempt(act, answer) for answer in answers]

        return compute_valid(
            [attempt(converted, *each) for each in zip(obs, sessions, strict=True)], ask
        )

    def close(self) -> None:
        for connections in (self._lanes, self._sessions):
            if connections is not None:
                connections.close()

    def _ask(self, sessions: Sequence[Any], observations: Sequence[Mapping[str, Any]]) -> list[Any]:
        if self._sessions is not None:
            return list(
                self._sessions.ask([session._session or "" for session in sessions], observations)
            )
        if self._lanes is None:
            raise NotReset("upstream: act before initialize; there is no connection")
        return list(self._lanes.ask(observations))

    def _check(self, client: UpstreamClient, metadata: Mapping[str, Any]) -> None:
        differences = client.differences(metadata, self._outgoing)
        chunk = client.chunk(metadata)
        configured = self.config.contract.get("chunk")
        if configured is not None and chunk is not None and configured != chunk:
            differences.append(
                f"chunk: the upstream gives {chunk} rows, contract.chunk says {configured}; "
                "change it"
            )

        if differences:
            lines = "\n".join(f"- {line}" for line in differences)
            raise ContractMismatch(
                f"upstream {client.options.url} and the deployment's mapping do not fit:\n{lines}"
            )
        if chunk is not None:
            self._state["contract"] = replace(self.contract, chunk=chunk)


def _contract(mapped: Contract, configured: Mapping[str, Any]) -> Contract:
    """Return the contract of a mapping, overridden by the one in the deployment file."""
    overrides = {name: value for name, value in configured.items() if value is not None}
    fields: dict[str, Any] = mapped.to_json()
    action = fields["action"] | overrides.get("action", {})
    return Contract.from_json(fields | overrides | {"action": action})
