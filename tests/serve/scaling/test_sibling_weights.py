"""What a push makes of the errors of other replicas' actors."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from ray.exceptions import ActorDiedError, ActorUnavailableError, RayTaskError

from vlagents_ray.errors import InvalidWeights
from vlagents_ray.serve.scaling import sibling_replicas
from vlagents_ray.serve.scaling.session_migration import PeerEnded, PeerUnreachable
from vlagents_ray.serve.weights import PushOptions, WeightUpdates


def raised(cause: Exception) -> RayTaskError:
    return RayTaskError("peer", "a traceback", cause)


@pytest.mark.parametrize(
    ("error", "becomes"),
    [
        (raised(InvalidWeights("'w': unknown")).as_instanceof_cause(), InvalidWeights),
        (raised(RuntimeError("no such method")), PeerUnreachable),
        (ActorDiedError(), PeerEnded),
        (ActorUnavailableError("the network is partitioned", None), PeerUnreachable),
        (TimeoutError(), PeerUnreachable),
    ],
    ids=lambda one: getattr(one, "__name__", type(one).__name__),
)
def test_errors_of_another_replica(monkeypatch: pytest.MonkeyPatch, error: Exception, becomes: type[Exception]) -> None:
    async def call(actor: Any, method: Any, *args: Any) -> Any:
        assert (actor, method.__name__, args) == ("actor", "peer", ("WeightUpdates.stage", 1, {}, PushOptions()))
        raise error

    monkeypatch.setattr(sibling_replicas, "call_replica", call)
    replica = sibling_replicas._Sibling("r1", "actor")
    with pytest.raises(becomes) as found:
        asyncio.run(replica.weights(WeightUpdates.stage, 1, {}, PushOptions()))
    assert type(found.value) is becomes
    assert str(found.value)
