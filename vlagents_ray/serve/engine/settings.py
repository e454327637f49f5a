"""The settings of an engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from vlagents_ray.contract import Contract
from vlagents_ray.policies.loading import Invariant
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, REPLY_BYTES
from vlagents_ray.serve.queue.call_limits import CallLimits


def accept_any(_: Contract | None) -> None:
    """Accept a policy with any contract."""


@dataclass(frozen=True, slots=True)
class EngineSettings:
    """The settings of an engine, including the settings of a deployment that concern it."""

    max_batch_size: int = 16  # maximum number of observations in a batch
    patience: float = 0.0  # see `BatchQueue`
    # Sizes to which batches are padded; the largest one is `max_batch_size`. If there are none, a
    # compiled policy that specifies no sizes is compiled for 1, 2, 4, … `max_batch_size`.
    batch_sizes: Sequence[int] = ()
    # Whether each forward pass has `max_batch_size` rows, so that the bits of an action do not
    # depend on its batch.
    invariant: Invariant = False
    session_limit: int = 1000  # maximum number of sessions
    session_idle_s: float = 600.0  # time without a request after which a session may be dropped, s
    # Version of the policy; sessions only move between replicas of equal version and settings.
    version: str = ""
    # Function that raises an error if a policy with a given contract cannot be served.
    check: Callable[[Contract | None], None] = accept_any
    # Time limits of the policy's calls, above which the engine is unhealthy.
    limits: CallLimits = field(default_factory=CallLimits)
    reply_bytes: int = REPLY_BYTES  # maximum size of a reply
    # Maximum size of all messages in flight together, bytes.
    in_flight_bytes: int = DEFAULT_LIMITS.in_flight_bytes
    # Whether a thread of the engine runs the policy. Otherwise the thread that calls `start` runs
    # the policy, and then calls `queue.take` and `runner.run` alternately.
    threaded: bool = True

    @property
    def padded_sizes(self) -> Sequence[int]:
        """The numbers of rows to which forward passes are padded; empty if they are not."""
        return (self.max_batch_size,) if self.invariant else self.batch_sizes
