"""One checkpoint in memory: loading it, and giving its memory back."""

from __future__ import annotations

import gc
import json
import logging
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.contract import Contract, check_observation, require_match
from vlagents_ray.errors import UnknownSession
from vlagents_ray.interface import Agent
from vlagents_ray.serve.checkpoints import Checkpoints, Wish, resolved
from vlagents_ray.serve.padding import Padding
from vlagents_ray.serve.sessions import AgentCopies
from vlagents_ray.wire.messages import Request

logger = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class Model:
    """A loaded agent, and what its sessions have in common."""

    wish: Wish  # by which it was asked for first
    settings: dict[str, Any]
    key: str  # `key_of` them
    agent: Agent
    contract: Contract | None
    copies: AgentCopies
    padding: Padding
    version: tuple[str, str]  # equal in replicas that can take each other's sessions of it over
    since: float = field(default_factory=time.monotonic)
    sessions: int = 0  # that have an episode on it, or are about to
    closed: bool = False
    busy: threading.Lock = field(default_factory=threading.Lock)  # held while its agent runs, or is closed

    @property
    def checkpoint(self) -> str | None:
        """What its sessions are told that they act by."""
        return resolved(self.settings) or self.wish.choice

    def check(self, request: Request) -> None:
        """Raise what of the request does not fit the contract."""
        if request.contract is not None:
            require_match(self.contract, Contract.from_json(request.contract))
        for obs in (*request.history, request.obs):
            if obs is not None:
                check_observation(obs, self.contract)

    def require_open(self) -> None:
        """`UnknownSession` if it was closed while somebody waited for `busy`: its sessions had ended by then."""
        if self.closed:
            raise UnknownSession(f"{self.wish} has just been unloaded for another; reset the session")

    def close(self) -> None:
        """Give back what it took, after the batch under way. The memory is free when nobody refers to it any more."""
        with self.busy:
            self.closed = True
            _give_back(self.agent)


class Loader:
    """Makes models of settings."""

    def __init__(
        self,
        source: Checkpoints,
        version: str,
        batch_sizes: Sequence[int],
        check: Callable[[Contract | None], None],
    ) -> None:
        """See `Engine`."""
        self._source = source
        self._version = version
        self._batch_sizes = batch_sizes
        self._check = check

    def load(self, wish: Wish, settings: dict[str, Any], agent: Agent | None = None) -> Model:
        """A model of `agent`, or of one made here; what it took is given back if it cannot be served."""
        agent = agent or self._source.make(settings)
        try:
            agent.initialize()
            contract = agent.contract
            self._check(contract)
            copies = AgentCopies(agent)
            copies.make()  # an agent that cannot be copied must fail now, not at the first reset
        except BaseException:
            _give_back(agent)
            raise
        padding = Padding(self._batch_sizes, copies.make)
        version = (self.version(settings), copies.fingerprint)
        return Model(wish, settings, key_of(settings), agent, contract, copies, padding, version)

    def version(self, settings: Mapping[str, Any]) -> str:
        """Of the policy with these settings."""
        return f"{self._version} {key_of(settings)}"


def key_of(settings: Mapping[str, Any]) -> str:
    """Equal for equal settings."""
    return json.dumps(settings, sort_keys=True)


def free_memory() -> None:
    """Have the memory back now: agents often refer to themselves, and torch keeps what it once took."""
    gc.collect()
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        torch.cuda.empty_cache()


def _give_back(agent: Agent) -> None:
    try:
        agent.close()
    except Exception:
        logger.exception("%s: could not be closed", type(agent).__name__)
