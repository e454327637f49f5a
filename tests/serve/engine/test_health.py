"""When a replica is replaced: its accelerator has failed, or its policy fails batch after batch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from in_flight import answered

from vlagents_ray.errors import InvalidObservation, PolicyFailed, PolicyUnavailable
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.queue.call_limits import FAILED_BATCHES

ASSERT = "CUDA error: device-side assert triggered"


class Failing(Agent):
    """Raises the error that a call is to raise."""

    shared = ("errors",)

    def __init__(self) -> None:
        self.errors: dict[str, Exception] = {"none": ValueError()}  # by op; an empty one would not be shared

    def _raise(self, op: str) -> None:
        if op in self.errors:
            raise self.errors[op]

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._raise("reset")
        return {}

    def observe(self, obs: Obs) -> None:
        self._raise("observe")

    def act(self, obs: Obs) -> Act:
        self._raise("act")
        return Act(np.zeros(1, np.float32))

    def act_batch(self, obs: Any, sessions: Any) -> list[Act | Exception]:
        self._raise("act_batch")
        return super().act_batch(obs, sessions)


@pytest.fixture
def agent() -> Failing:
    return Failing()


@pytest.fixture
def engine(agent: Failing, serving: Callable[..., Engine]) -> Engine:
    return serving(agent)


@pytest.fixture
def ask(engine: Engine) -> Callable[[Any], Exception | None]:
    return lambda op: answered(engine, "a", Request(op, Obs())).error


@pytest.mark.parametrize("op", ["reset", "observe", "act", "act_batch"])
def test_a_replica_whose_accelerator_failed_is_not_healthy_and_sends_its_clients_away(
    engine: Engine, agent: Failing, ask: Callable[[Any], Exception | None], op: str
) -> None:
    assert ask("reset") is None
    engine.check_health()
    agent.errors[op] = RuntimeError(f"{ASSERT}\nmore")
    assert isinstance(ask(op.removesuffix("_batch")), PolicyFailed)
    agent.errors.clear()
    with pytest.raises(PolicyUnavailable, match=ASSERT):
        engine.check_health()
    assert not engine.ready
    for later in ("reset", "act"):
        with pytest.raises(PolicyUnavailable, match="begins again at another one"):
            ask(later)


@pytest.mark.parametrize("op", ["act", "act_batch"])
def test_a_replica_all_of_whose_batches_fail_is_not_healthy_until_one_does_not(
    engine: Engine, agent: Failing, ask: Callable[[Any], Exception | None], op: str
) -> None:
    assert ask("reset") is None
    agent.errors[op] = ZeroDivisionError("of the policy")
    for _ in range(FAILED_BATCHES):
        engine.check_health()
        assert isinstance(ask("act"), PolicyFailed)
    with pytest.raises(PolicyFailed, match=f"the last {FAILED_BATCHES} batches failed as a whole"):
        engine.check_health()
    agent.errors.clear()
    assert ask("act") is None
    engine.check_health()


@pytest.mark.parametrize(
    "error",
    [InvalidObservation("of a client"), PolicyUnavailable("of a policy elsewhere"), RuntimeError("CUDA out of memory")],
)
def test_what_another_replica_could_not_do_better_leaves_a_replica_healthy(
    engine: Engine, agent: Failing, ask: Callable[[Any], Exception | None], error: Exception
) -> None:
    assert ask("reset") is None
    agent.errors["act"] = error
    rounds = 1 if isinstance(error, RuntimeError) else FAILED_BATCHES + 1
    assert all(ask("act") is not None for _ in range(rounds))
    engine.check_health()
