"""How a server takes its leave of Serve."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import ray
from ray.exceptions import ActorDiedError, GetTimeoutError
from ray.serve._private.router import SharedRouterLongPollClient

from vlagents_ray.serve.launch import serve_client


@pytest.mark.parametrize(("error", "said"), [(ActorDiedError(), False), (GetTimeoutError(), True)])
def test_a_controller_that_ends_or_that_does_not_answer_is_no_error(
    error: Exception, said: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    ending = SimpleNamespace(remote=lambda: None)
    controller = SimpleNamespace(graceful_shutdown=SimpleNamespace(options=lambda **_: ending))
    client = SimpleNamespace(
        _controller=controller, handle_cache={}, shutdown_cached_handles=lambda: None, _shutdown=False
    )
    monkeypatch.setattr(ray, "get", fail)
    serve_client.shut_down(client)
    assert client._shutdown
    assert ("has not ended within" in caplog.text) is said


def test_a_controller_that_is_about_to_end_is_asked_for_no_more_news(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray would tell the user of a failed task, in one end of four."""
    stopped: list[str] = []
    own = SimpleNamespace(stop=lambda: stopped.append("own"))
    shared = SimpleNamespace(long_poll_client=SimpleNamespace(stop=lambda: stopped.append("shared")))
    monkeypatch.setattr(SharedRouterLongPollClient, "get_or_create", lambda *_: shared)
    used = SimpleNamespace(
        _router=SimpleNamespace(_asyncio_router=SimpleNamespace(long_poll_client=own, _event_loop=1))
    )
    unused = SimpleNamespace(_router=None)
    serve_client._stop_long_polls(SimpleNamespace(_controller=None, handle_cache={"used": used, "unused": unused}))
    assert stopped == ["own", "shared"]
