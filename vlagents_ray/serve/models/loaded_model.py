"""A loaded agent with the data that its sessions share, and the loader that creates it."""

from __future__ import annotations

import copy
import json
import logging
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

from vlagents_ray.abilities import BeginsWithPlan, ContinuesPlans, HasStatistics, ability
from vlagents_ray.contract import Contract, require_match
from vlagents_ray.errors import ConfigError, UnknownSession
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.act_stream import ActStream, GpuCalls
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.policies.base.checkpoint import (
    CHECKPOINT,
    checkpoint_name,
    resolved,
    used_checkpoints,
)
from vlagents_ray.policies.base.checkpoint_files import identify_weights, success_of
from vlagents_ray.policies.base.program import Program, digest_of, files_named, with_defaults
from vlagents_ray.policies.loading import Invariant, LoadingReport, loading_report
from vlagents_ray.policies.wrapper import unwrapped
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.in_time import tolerated_age_ms
from vlagents_ray.serve.models.invariance import batch_variation
from vlagents_ray.serve.queue.call_limits import LOAD, PolicyCall, PolicyCalls
from vlagents_ray.serve.weights import HoldsWeights, ModelWeights
from vlagents_ray.success import SuccessCurve
from vlagents_ray.validation import check_observation, check_reset

logger = logging.getLogger(__name__)

# Number of acts after which a dummy session is replaced, since its agent may store every
# observation.
_LIFE = 1000
# Number of hexadecimal digits of a checkpoint's digest that are the fingerprint of its weights.
_FINGERPRINT_DIGITS = 16


@dataclass(slots=True)
class _DummySession:
    agent: Agent
    acts: int = 0


def powers_up_to(largest: int) -> list[int]:
    """Return the powers of two below `largest`, and `largest` itself: 1, 2, 4, …"""
    return [*(2**power for power in range((largest - 1).bit_length())), largest]


class Padding:
    """Dummy sessions that pad a batch to the next of `sizes`. They are only used on the policy's
    thread.

    Each dummy session is a pristine copy of the agent. The dummy session is reset with the first
    reset request that the policy accepted, and acts on an observation of a real session in the same
    batch. Its actions and errors are dropped. If a dummy session cannot be created, the policy gets
    batches without padding.

    Args:
        sizes: Batch sizes for which the model is compiled.
        make: Returns a pristine copy of the agent.
    """

    def __init__(self, sizes: Sequence[int], make: Callable[[], Agent]) -> None:
        self._sizes = sorted(sizes)
        self._make = make
        self._first: tuple[Obs, str | None, dict[str, Any]] | None = None
        self._rows: list[_DummySession] = []

    def record_reset(self, request: Request, kwargs: dict[str, Any]) -> None:
        """Store the first reset that the policy accepted, which is also used to reset the dummy
        sessions.
        """
        if self._first is None and self._sizes and request.obs is not None:
            # The request is copied, since the observation may be in the sender's memory.
            self._first = copy.deepcopy((request.obs, request.instruction, kwargs))

    def sessions(self, rows: int) -> list[Agent]:
        """Return the dummy sessions that pad a batch of `rows` to the next size; none if `rows`
        exceeds the largest size.
        """
        missing = next((size for size in self._sizes if size >= rows), rows) - rows
        # All sessions so far were moved here from other replicas, without a reset.
        if self._first is None:
            return []
        try:
            while len(self._rows) < missing:
                agent = self._make()
                obs, instruction, kwargs = copy.deepcopy(self._first)
                agent.reset(obs, instruction, **kwargs)
                self._rows.append(_DummySession(agent))
        except Exception:
            logger.exception("batches are not padded, since the dummy session could not be reset")
            self._sizes.clear()
            self._rows.clear()
            return []
        return [row.agent for row in self._rows[:missing]]

    def check_results(self, results: Sequence[Act | Exception]) -> None:
        """Check the results of the dummy sessions, and discard the sessions that failed or have
        made `_LIFE` acts.
        """
        used = self._rows[: len(results)]
        for row in used:
            row.acts += 1
        usable = [
            row
            for row, result in zip(used, results, strict=True)
            if isinstance(result, Act) and row.acts < _LIFE
        ]
        self._rows[: len(results)] = usable


@dataclass(slots=True, eq=False)
class LoadedModel:
    """A loaded agent, and the data that its sessions share."""

    checkpoint: str | None  # name of the checkpoint, see `checkpoint_name`
    agent: Agent
    contract: Contract | None
    copies: AgentCopies
    padding: Padding
    # Digest and revision of the weights (see `HasWeightsId`), statistics (see `HasStatistics`), and
    # curves of success as JSON (see `HasSuccess`).
    weights: dict[str, Any] | None
    files: Program  # digests of the files named in the settings
    # Equal in replicas that can take over each other's sessions of this model.
    version: tuple[str, str]
    calls: PolicyCalls  # running calls of the replica, including the calls of this agent
    parameters: ModelWeights  # versions of the weights
    busy: threading.Lock  # lock that is held while the agent runs, or is being closed
    report: LoadingReport  # devices and other facts that the model reported while loading
    continues_plans: bool  # whether chunks continue the executed plan
    # Maximum number of rows of the executed plan that a chunk repeats exactly at its beginning; 0
    # for none.
    longest_prefix: int
    # Why the bits of an action may depend on its batch; None if they do not.
    variation: str | None
    closed: bool = False
    # The stream of the agent's calls, on any thread; None without a GPU of torch.
    acts: ActStream | None = field(init=False)
    # Held together with `busy` while the agent runs, so that no other model of this process is
    # captured as a CUDA graph. Without an accelerator, each model has a separate lock, which costs
    # less.
    uncaptured: AbstractContextManager[Any] = field(init=False)
    # The largest age of an executed action that the policy tolerates, ms; None if it is not known.
    tolerated_age_ms: float | None = field(init=False)
    _calls_by_kind: dict[tuple[str, Hashable], PolicyCall] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Determine whether this process computes on an accelerator, and read the measured
        success.
        """
        curves = (self.weights or {}).get("success", ())
        self.tolerated_age_ms = tolerated_age_ms(map(SuccessCurve.from_json, curves))
        torch = sys.modules.get("torch")
        self.acts = ActStream.for_report(self.report)
        self.uncaptured = (
            GpuCalls(self.acts)
            if self.report.accelerated or (torch and torch.cuda.is_initialized())
            else threading.RLock()
        )

    @property
    def identity(self) -> dict[str, str]:
        """The checkpoint, digest and commit of the loaded weights, for the info of a reset."""
        weights = self.weights or {}
        known = {
            "checkpoint": self.checkpoint,
            "weights": weights.get("digest"),
            "revision": weights.get("revision"),
        }
        return {name: value for name, value in known.items() if value is not None}

    def check(self, request: Request) -> None:
        """Raise an error if the request does not match the model's contract."""
        if request.contract is not None:
            require_match(self.contract, Contract.from_json(request.contract))
        for obs in (*request.history, request.obs):
            if obs is not None:
                check_observation(obs, self.contract)

    def call(self, op: str, kind: Hashable = None) -> PolicyCall:
        """Return a context manager for a call of the agent, which detects calls that do not return.

        Calls with the same `op` and `kind` take similarly long, and never run on two threads at the
        same time.
        """
        call = self._calls_by_kind.get((op, kind))
        if call is None:
            call = self._calls_by_kind[op, kind] = PolicyCall(self.calls, op)
        return call

    def require_open(self) -> None:
        """Raise `UnknownSession` if the model and its sessions have been closed; the caller
        holds `busy`.
        """
        if self.closed:
            raise self.replaced()

    def replaced(self) -> UnknownSession:
        """Return the error for a session of this model, which is closed."""
        return UnknownSession(
            "the policy has just been replaced by one with other settings; reset the session"
        )

    def pad(self, observations: list[Obs | None], agents: list[Agent | None]) -> int:
        """Append rows that pad a batch to the next size, and return their number. It is only called
        on the policy's thread.
        """
        if self.closed:
            return 0
        with self.call("reset", "padding"):
            padding = self.padding.sessions(len(agents))
        observations += observations[-1:] * len(padding)
        agents += padding
        return len(padding)

    def close(self, wait_s: float = -1.0) -> None:
        """Close the agent after the running batch, once. The agent's memory is freed when no
        reference to the agent remains.

        If the batch is still running after `wait_s` (-1: no limit), the agent stays open until this
        process ends.
        """
        if not self.busy.acquire(timeout=wait_s):
            logger.error("the policy is still busy after %g s; it is not closed", wait_s)
            return
        try:
            if not self.closed:
                self.closed = True
                with self.call("close"):
                    _close_agent(self.agent)
        finally:
            self.busy.release()


@dataclass(slots=True)
class GpuWork:
    """The work of a process on its GPUs since its last report, for the metrics."""

    passes_ms: list[float] = field(default_factory=list)  # a sample of the times of forward passes
    last_ms: float | None = None  # time of the last forward pass
    out_of_memory: int = 0  # forward passes that did not fit into memory
    replays: int = 0  # replays of CUDA graphs


class ComputesElsewhere(ABC):
    """An agent that computes in another process, which also allocates the memory."""

    @abstractmethod
    def gpu_memory(self) -> dict[str, int]:
        """Return the memory of the GPUs of the other process, see `accelerator.gpu_memory`."""

    @abstractmethod
    def gpu_work(self) -> GpuWork:
        """Return the work of the other process on its GPUs since the last call."""

    @abstractmethod
    def software(self) -> Program:
        """Return the software of the other process, see `policies.base.program.software`."""


class ModelStats(Protocol):
    """Records the reports of models while they compute: the `MetricsBuffer` of an engine."""

    def out_of_memory(self) -> None:
        """Record a forward pass that did not fit into the accelerator's memory."""

    def gpu(self, took_ms: float) -> None:
        """Record the time of a forward pass on the GPU."""


@dataclass(frozen=True, slots=True)
class PolicySource:
    """The function that creates a policy's agents, and the settings of the first agent."""

    make: Callable[[Mapping[str, Any]], Agent]  # creates an agent, without loading anything
    config: Mapping[str, Any] = field(default_factory=dict)


class Loader:
    """Loads models from settings."""

    def __init__(
        self,
        make: Callable[[Mapping[str, Any]], Agent],
        version: str,
        padded_sizes: Sequence[int],
        max_batch_size: int,
        check: Callable[[Contract | None], None],
        calls: PolicyCalls,
        stats: ModelStats,
        *,
        invariant: Invariant = False,
    ) -> None:
        """Create the loader; `make` is described at `PolicySource`, and `stats` records the reports
        of the models. `EngineSettings` describes the other arguments.
        """
        self._make, self._version, self._padded_sizes = make, version, padded_sizes
        self._compiled_sizes = padded_sizes or powers_up_to(max_batch_size)
        self._check, self._calls, self._stats = check, calls, stats
        self._invariant = invariant

    def load(self, settings: Mapping[str, Any], on_progress: Callable[[str], None]) -> LoadedModel:
        """Load a model into a new agent, which is closed if it cannot be served.

        Args:
            settings: The settings of the agent.
            on_progress: Called with each step of a long load.

        Raises:
            BaseException: Any error of the agent's initialization, or of the deployment's check of
                its contract.
        """
        with PolicyCall(self._calls, LOAD):
            return self._load(settings, on_progress)

    def _load(self, settings: Mapping[str, Any], on_progress: Callable[[str], None]) -> LoadedModel:
        agent = self._make(settings)
        try:
            check_reset(unwrapped(agent))
            with (
                used_checkpoints() as checkpoints,
                loading_report(
                    on_progress,
                    self._compiled_sizes,
                    self._stats.out_of_memory,
                    self._stats.gpu,
                    invariant=bool(self._invariant),
                ) as report,
            ):
                agent.initialize()
            weights = identify_weights(agent, checkpoints)
            full_settings = with_defaults(type(unwrapped(agent)), settings)
            files = files_named(
                {**full_settings, CHECKPOINT: resolved(full_settings)}, folders=not weights
            )
            if weights is None and files:
                weights = {"digest": digest_of(files), "revision": None}
            # Statistics are compared with a robot's values. They may also exist for weights without
            # a digest.
            trained_on = ability(agent, HasStatistics)
            if trained_on is not None:
                weights = {
                    "digest": None,
                    "revision": None,
                    **(weights or {}),
                    "statistics": trained_on.statistics,
                }

            # A wrapper changes the actions, so that the checkpoint's success is not the policy's.
            curves: list[dict[str, Any]] = []
            if weights is not None and unwrapped(agent) is agent:
                curves = success_of(checkpoints, weights["digest"])
            if weights is not None and curves:
                weights = {**weights, "success": curves}

            variation = self._variation(agent, report)
            contract = agent.contract
            self._check(contract)
            copies = AgentCopies(agent)
            copies.make()  # an agent that cannot be copied must fail now, not at the first reset
            plans = ability(agent, ContinuesPlans)
            continues_plans = plans is not None and plans.continues_plans
            prefixes = ability(agent, BeginsWithPlan)
            longest_prefix = 0 if prefixes is None else prefixes.longest_prefix
        except BaseException:
            _close_agent(agent)
            raise

        # With `invariant`, a policy that does not pad its batches computes each row alone.
        pads = report.pads or bool(self._invariant)
        padding = Padding(() if pads else self._padded_sizes, copies.make)
        digest = (weights or {}).get("digest") or ""
        version = (self.version(settings), f"{copies.fingerprint} {digest}")
        if weights is not None and digest:
            logger.info("weights: %s, revision: %s", digest, weights.get("revision"))

        busy = threading.Lock()
        make = (
            agent.model_weights if isinstance(agent, HoldsWeights) else partial(ModelWeights, agent)
        )
        parameters = make(busy, digest.rpartition(":")[2][:_FINGERPRINT_DIGITS], version)
        calls = self._calls
        return LoadedModel(
            checkpoint_name(settings),
            agent,
            contract,
            copies,
            padding,
            weights,
            files,
            version,
            calls,
            parameters,
            busy,
            report,
            continues_plans,
            longest_prefix,
            variation,
        )

    def _variation(self, agent: Agent, report: LoadingReport) -> str | None:
        """Return why the bits of an action may depend on its batch; None if they do not.

        Raises:
            ConfigError: They may, and the deployment requires that they do not.
        """
        if not self._invariant:
            return "batch.invariant is off"
        variation = batch_variation(agent, report, self._compiled_sizes[-1])
        if variation is not None and self._invariant is True:
            raise ConfigError(
                "batch.invariant: expected a policy whose actions do not depend on their batch, "
                f"got one that may: {variation}; set batch.max_size to 1, or leave `invariant` out"
            )
        logger.info("actions depend on their batch: %s", variation or "no, not on any bit")
        return variation

    def version(self, settings: Mapping[str, Any]) -> str:
        """Return the version of the policy that has these settings."""
        return f"{self._version} {json.dumps(settings, sort_keys=True)}"


def _close_agent(agent: Agent) -> None:
    try:
        agent.close()
    except Exception:
        logger.exception("%s: could not be closed", type(agent).__name__)
