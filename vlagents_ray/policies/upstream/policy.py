"""Another policy server's model as a policy."""

from __future__ import annotations

import os
import time
import uuid
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, ContractMismatch, NotReset
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.upstream.client import ClientOptions, UpstreamClient
from vlagents_ray.policies.upstream.config import UpstreamConfig
from vlagents_ray.policies.upstream.connections import Lanes, SessionConnections
from vlagents_ray.wire.outgoing import Outgoing

UPSTREAM_MS = "upstream_ms"  # in `Act.info`: the time that the upstreams needed for the batch, ms


class Upstream(Agent):
    """Asks the servers of another system for the actions of each batch.

    The observation is sent with the upstream's own keys, as the mapping says. Its actions are returned as they are; the
    contract states its gripper's commands.
    """

    Config: ClassVar[type] = UpstreamConfig
    shared: ClassVar[tuple[str, ...]] = ("config", "_outgoing", "_lanes", "_sessions", "_state")

    def __init__(self, config: UpstreamConfig) -> None:
        self.config = config
        client = config.client
        self._outgoing = Outgoing(config.keys(), client.is_nested, client.text_key)
        self._state: dict[str, Any] = {"contract": _contract(self._outgoing.contract(), config.contract)}
        self._lanes: Lanes | None = None
        self._sessions: SessionConnections | None = None
        self._session: str | None = None
        self._instruction: str | None = None

    @property
    def contract(self) -> Contract:
        """The contract by the mapping and the settings, with the length of a chunk, if the upstream states it."""
        contract: Contract = self._state["contract"]
        return contract

    def initialize(self) -> None:
        """Connect to the upstreams, and compare the mapping with what they say about themselves.

        Raises:
            ContractMismatch: They differ.
            PolicyUnavailable: None answers in time.
        """
        key = None
        if (name := self.config.key_env) is not None and not (key := os.environ.get(name)):
            raise ConfigError(f"key_env: the environment variable {name!r} is not set; set it where the replica runs")

        config, instructions = self.config, self.config.instructions()

        def make(url: str) -> UpstreamClient:
            options = ClientOptions(
                url, config.timeout_s, key, instructions=instructions, load_s=config.connect_timeout_s
            )
            return config.client(options)

        if self.config.keeps_sessions:
            self._sessions = SessionConnections(self.config.urls, make, self._check, self.config.retry_s)
            self._sessions.start(self.config.connect_timeout_s)
        else:
            clients = [make(url) for _ in range(self.config.connections) for url in self.config.urls]
            self._lanes = Lanes(clients, self._check, self.config.retry_s)
            self._lanes.start(self.config.connect_timeout_s)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode, at the upstream too if that keeps sessions."""
        self._instruction = instruction
        if self._sessions is not None:
            self._session = uuid.uuid4().hex
            self._sessions.begin(self._session)
            ended = weakref.finalize(self, self._sessions.drop, self._session)  # the copy ends with its session
            ended.atexit = False
        return {}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Ask the upstreams for the actions of all sessions at once; an error is that of its session alone."""
        results: list[Any] = [None] * len(obs)
        asked: list[tuple[int, dict[str, Any]]] = []
        for i, (one, session) in enumerate(zip(obs, sessions, strict=True)):
            try:
                asked.append((i, self._outgoing.observation(one, session._instruction)))  # type: ignore[attr-defined]
            except Exception as error:  # noqa: BLE001 - returned to the session whose request failed
                results[i] = error
        begun = time.perf_counter()
        answers = self._ask([sessions[i] for i, _ in asked], [theirs for _, theirs in asked]) if asked else []
        info = {UPSTREAM_MS: (time.perf_counter() - begun) * 1e3}
        for (i, _), answer in zip(asked, answers, strict=True):
            try:
                results[i] = answer if isinstance(answer, Exception) else Act(self._outgoing.rows(answer), info=info)
            except Exception as error:  # noqa: BLE001 - returned to the session whose request failed
                results[i] = error
        return results

    def close(self) -> None:
        """Close the connections."""
        for connections in (self._lanes, self._sessions):
            if connections is not None:
                connections.close()

    def _ask(self, sessions: Sequence[Any], observations: Sequence[Mapping[str, Any]]) -> list[Any]:
        if self._sessions is not None:
            return list(self._sessions.ask([session._session or "" for session in sessions], observations))
        if self._lanes is None:
            raise NotReset("upstream: act before initialize; there is no connection")
        return list(self._lanes.ask(observations))

    def _check(self, client: UpstreamClient, metadata: Mapping[str, Any]) -> None:
        """Compare the mapping and the contract with what an upstream says about itself."""
        found = client.differences(metadata, self._outgoing)
        stated, chunk = self.config.contract.get("chunk"), client.chunk(metadata)
        if stated is not None and chunk is not None and stated != chunk:
            found.append(f"chunk: the upstream gives {chunk} rows, contract.chunk says {stated}; change it")
        if found:
            lines = "\n".join(f"- {line}" for line in found)
            raise ContractMismatch(f"upstream {client.options.url} and the deployment's mapping do not fit:\n{lines}")
        if chunk is not None:
            self._state["contract"] = replace(self.contract, chunk=chunk)


def _contract(mapped: Contract, stated: Mapping[str, Any]) -> Contract:
    """Return the contract of a mapping, with what the deployment states in place of it."""
    own = {name: value for name, value in stated.items() if value is not None}
    whole: dict[str, Any] = mapped.to_json() | own
    whole["action"] = mapped.to_json()["action"] | own.get("action", {})
    return Contract.from_json(whole)
