"""The policy `upstream`, which is the model of another policy server, and its settings."""

from __future__ import annotations

import os
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
    ] = Field(description="protocol of the other server")
    urls: list[str] = Field(
        min_length=1,
        max_length=64,
        description="addresses of servers with the same model, e.g. ws://gpu-box:8000, "
        "tcp://gpu-box:5555 (gr00t), http://gpu-box:8000 (openvla, sglang, flashrt); a batch is "
        "spread over them",
    )
    mapping: str | dict[str, Any] | None = Field(
        default=None,
        description="our names of the upstream's keys: the name of a preset, or an object, as for "
        "dialects; default: the preset of the protocol, except for openpi, whose robots have "
        "different keys",
    )
    contract: dict[str, Any] = Field(
        default_factory=dict,
        description="the contract of the model, as far as it does not follow from the mapping, "
        "e.g. action: {dim: 7}, chunk",
    )
    sessions: Literal["none", "connection"] | None = Field(
        default=None,
        description="none: the model keeps nothing between two observations, and connections are "
        "shared; connection: each session has its own connection, and is reset; default: "
        "connection for roboarena and vla_eval",
    )
    connections: int = Field(
        default=1,
        ge=1,
        le=64,
        description="number of connections to each URL, over which a batch is spread; for "
        "`sessions: none`",
    )
    timeout_s: float = Field(
        default=30.0,
        gt=0,
        description="time limit for an answer, after which the connection counts as lost, s",
    )
    retry_s: float = Field(
        default=2.0,
        ge=0,
        description="time for which a request waits for a lost upstream, before the answer is 503, "
        "s",
    )
    connect_timeout_s: float = Field(
        default=600.0,
        gt=0,
        description="time limit for the first answer of an upstream at the start, s",
    )
    key_env: str | None = Field(
        default=None, description="name of the environment variable with the upstream's API key"
    )

    @field_validator("contract")
    @classmethod
    def _readable(cls, value: dict[str, Any]) -> dict[str, Any]:
        """Reject a contract that cannot be read."""
        try:
            Contract.from_json(value)
        except VLAgentsError as error:
            raise ValueError(str(error)) from error
        return value

    @model_validator(mode="after")
    def _fit(self) -> Self:
        """Reject settings that do not fit the protocol."""
        for url in self.urls:
            address = urlsplit(url)
            if address.scheme not in self.client.schemes or not address.hostname:
                forms = " or ".join(f"{scheme}://HOST:PORT" for scheme in self.client.schemes)
                raise ValueError(f"urls: expected {forms} for {self.protocol}, got {url!r}")
            if address.username is not None or address.password is not None:
                raise ValueError(
                    "urls: expected no name and no password in them, got one; put the key into a "
                    "variable, and name it in key_env"
                )
        if self.key_env is not None and not self.client.takes_key:
            raise ValueError(
                f"key_env: expected none, as {self.protocol} has no place for a key, got one; "
                "remove it"
            )
        if self.mapping is None and self.client.mapping is None:
            raise ValueError(
                f"mapping: {self.protocol} has no default; give an object, or a preset, such "
                "as openpi-libero for openpi"
            )
        self.keys()  # raises an error for an invalid mapping
        return self

    @property
    def client(self) -> type[UpstreamClient]:
        """The class of the protocol's clients."""
        return PROTOCOLS[self.protocol]

    @property
    def keeps_sessions(self) -> bool:
        """Whether each session has its own connection."""
        if self.sessions is None:
            return self.client.keeps_sessions
        return self.sessions == "connection"

    def keys(self) -> KeyMapping:
        """Return the mapping, by default the mapping of the protocol."""
        return read_mapping(self.mapping if self.mapping is not None else str(self.client.mapping))


class Upstream(Agent):
    """Requests the actions of each batch from the servers of another system.

    The mapping converts the observation to the upstream's own keys. The upstream's actions are
    returned unchanged; the contract declares the range of their gripper commands.

    Args:
        config: The settings.
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
        upstream's metadata contain it.
        """
        return self._state["contract"]

    def initialize(self) -> None:
        """Connect to the upstreams.

        Raises:
            ConfigError: The variable with the API key is not set.
            ContractMismatch: The metadata of an upstream contradict the mapping.
            PolicyUnavailable: No upstream answers in time.
        """
        config = self.config
        key = None
        if config.key_env is not None:
            key = os.environ.get(config.key_env)
            if not key:
                raise ConfigError(
                    f"key_env: the environment variable {config.key_env!r} is not set; set it "
                    "where the replica runs"
                )

        def make(url: str) -> UpstreamClient:
            """Create a client for an address."""
            return config.client(ClientOptions(url, config.timeout_s, key))

        if config.keeps_sessions:
            self._sessions = SessionConnections(config.urls, make, self._check, config.retry_s)
            self._sessions.start(config.connect_timeout_s)
        else:
            clients = [make(url) for url in config.urls * config.connections]
            self._lanes = Lanes(clients, self._check, config.retry_s)
            self._lanes.start(config.connect_timeout_s)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode, also at the upstream if it keeps sessions."""
        self._instruction = instruction
        if self._sessions is not None:
            self._session = uuid.uuid4().hex
            self._sessions.begin(self._session)
            # This copy of the agent is deleted when its session ends.
            ended = weakref.finalize(self, self._sessions.drop, self._session)
            ended.atexit = False
        return {}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Request the actions of all sessions from the upstreams at the same time; an error fails
        only its own session.
        """

        def convert(session_obs: Obs, session: Any) -> tuple[Any, dict[str, Any]]:
            """Return a session, and its observation in the upstream's format."""
            return session, self._outgoing.observation(session_obs, session._instruction)

        def request(valid: list[tuple[Any, dict[str, Any]]]) -> list[Any]:
            """Return the action of each session, or the error in its place."""

            def act(answer: Any) -> Any:
                """Return the action in an answer."""
                if isinstance(answer, Exception):
                    return answer
                return Act(self._outgoing.rows(answer))

            answers = self._ask(*zip(*valid, strict=True))
            return [attempt(act, answer) for answer in answers]

        inputs = []
        for session_obs, session in zip(obs, sessions, strict=True):
            inputs.append(attempt(convert, session_obs, session))
        return compute_valid(inputs, request)

    def close(self) -> None:
        """Close all connections."""
        for connections in (self._lanes, self._sessions):
            if connections is not None:
                connections.close()

    def _ask(self, sessions: Sequence[Any], observations: Sequence[Mapping[str, Any]]) -> list[Any]:
        """Send the observations of sessions, and return the answer to each, or the error."""
        if self._sessions is not None:
            ids = [session._session or "" for session in sessions]
            return list(self._sessions.ask(ids, observations))
        if self._lanes is None:
            raise NotReset("upstream: act was called before initialize; there is no connection")
        return list(self._lanes.ask(observations))

    def _check(self, client: UpstreamClient, metadata: Mapping[str, Any]) -> None:
        """Raise `ContractMismatch` if an upstream's metadata contradict the mapping or the
        settings; otherwise set the length of a chunk.
        """
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
    """Return the contract of a mapping, overridden by the contract in the deployment file."""
    overrides = {name: value for name, value in configured.items() if value is not None}
    fields: dict[str, Any] = mapped.to_json()
    action = fields["action"] | overrides.get("action", {})
    return Contract.from_json(fields | overrides | {"action": action})
