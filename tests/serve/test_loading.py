"""When Serve calls an application's first replica running: at once, or when its policy has loaded."""

from __future__ import annotations

import asyncio
import threading
from types import SimpleNamespace

import pytest

from vlagents_ray.serve import deployment
from vlagents_ray.serve.config import ServerArgs
from vlagents_ray.serve.deployment import PolicyReplica


@pytest.mark.parametrize("at_once", [True, False])
def test_a_first_replica_runs_before_its_policy_has_loaded_unless_told_not_to(
    at_once: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(deployment, "_others_run", lambda: False)
    loaded = threading.Event()

    async def start() -> bool:
        replica = SimpleNamespace(  # what starting touches of one
            _args=ServerArgs(policy="noop", answer_while_loading=at_once),
            _engine=SimpleNamespace(start=lambda: loaded.wait(60)),
            _balance=SimpleNamespace(start=lambda: None),
            _watch_for_the_end=lambda: asyncio.sleep(0),
        )
        running = asyncio.ensure_future(PolicyReplica._start(replica))
        await asyncio.wait({running}, timeout=60 if at_once else 0.5)
        runs = running.done()
        loaded.set()
        await running
        await asyncio.gather(replica._loading, replica._watching)
        return runs

    assert asyncio.run(start()) is at_once
