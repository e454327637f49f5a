"""Settings of `upstream`: the protocol, the addresses, and what the other system's keys mean."""

from __future__ import annotations

from typing import Any, Literal
from urllib.parse import urlsplit

from pydantic import BaseModel, Field, field_validator, model_validator
from typing_extensions import Self

from vlagents_ray.contract import Contract
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.policies.upstream.clients.base import UpstreamClient
from vlagents_ray.policies.upstream.clients.protocols import PROTOCOLS
from vlagents_ray.wire.mapping.mapping import KeyMapping
from vlagents_ray.wire.presets import read_mapping


class UpstreamConfig(BaseModel, extra="forbid"):
    """Where the other policy server is, how it is asked, and how long it is waited for."""

    protocol: Literal["openpi", "openpi-batch", "roboarena", "gr00t", "openvla", "vla_eval", "vlagents"]
    urls: list[str] = Field(
        min_length=1,
        max_length=64,
        description="of servers with the same model, e.g. ws://gpu-box:8000, tcp://gpu-box:5555 (gr00t), "
        "http://gpu-box:8000 (openvla); a batch is spread over them",
    )
    mapping: str | dict[str, Any] | None = Field(
        default=None,
        description="our names of the upstream's keys: a preset's name, or an object, as for dialects; default: the "
        "protocol's own, except for openpi, whose robots have different keys",
    )
    contract: dict[str, Any] = Field(
        default_factory=dict,
        description="what is known about the model beyond the mapping, e.g. action: {dim: 7}, chunk",
    )
    sessions: Literal["none", "connection"] | None = Field(
        default=None,
        description="none: the model keeps nothing between two observations, and connections are shared; connection: a "
        "session has a connection of its own, and is reset; default: connection for roboarena and vla_eval",
    )
    connections: int = Field(
        default=1, ge=1, le=64, description="to each URL, over which a batch is spread too; for `sessions: none`"
    )
    timeout_s: float = Field(default=30.0, gt=0, description="for an answer; then the connection counts as lost, s")
    retry_s: float = Field(
        default=2.0, ge=0, description="for a lost upstream to return, before a request is answered with 503, s"
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
                    "urls: got a name or a password in one; put the key into a variable, and name it in key_env"
                )
        if self.key_env is not None and not self.client.takes_key:
            raise ValueError(f"key_env: {self.protocol} has no place for a key; remove it")
        if self.mapping is None and self.client.mapping is None:
            raise ValueError(
                f"mapping: {self.protocol} has none of its own; give a preset, such as openpi-libero, or an object"
            )
        self.keys()
        return self

    @property
    def client(self) -> type[UpstreamClient]:
        """The class of the protocol's clients."""
        return PROTOCOLS[self.protocol]

    @property
    def keeps_sessions(self) -> bool:
        """Whether each session has a connection of its own."""
        return self.client.keeps_sessions if self.sessions is None else self.sessions == "connection"

    def keys(self) -> KeyMapping:
        """Return the mapping; raises `ConfigError` if it is invalid."""
        return read_mapping(self.mapping if self.mapping is not None else str(self.client.mapping))
