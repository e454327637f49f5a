"""How a server takes its leave of Serve."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import ray
from ray.exceptions import ActorDiedError, GetTimeoutError

from vlagents_ray.serve import cluster


@pytest.mark.parametrize(("error", "said"), [(ActorDiedError(), False), (GetTimeoutError(), True)])
def test_a_controller_that_ends_or_that_does_not_answer_is_no_error(
    error: Exception, said: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    ending = SimpleNamespace(remote=lambda: None)
    controller = SimpleNamespace(graceful_shutdown=SimpleNamespace(options=lambda **_: ending))
    client = SimpleNamespace(_controller=controller, shutdown_cached_handles=lambda: None, _shutdown=False)
    monkeypatch.setattr(ray, "get", fail)
    cluster._shutdown(client)
    assert client._shutdown
    assert ("has not ended within" in caplog.text) is said
