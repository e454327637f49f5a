"""How a server takes its leave of Serve."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import ray
from ray.serve._private.router import SharedRouterLongPollClient

from vlagents_ray.ray_tools import head_monitor
from vlagents_ray.ray_tools.private import long_polls
from vlagents_ray.serve.launch import server


@pytest.mark.parametrize(("ends", "head", "said"), [(True, True, False), (False, True, True), (False, False, False)])
def test_a_controller_that_ends_or_that_does_not_answer_is_no_error(
    ends: bool, head: bool, said: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    ending = SimpleNamespace(remote=lambda: None)
    controller = SimpleNamespace(graceful_shutdown=SimpleNamespace(options=lambda **_: ending))
    client = SimpleNamespace(
        _controller=controller, handle_cache={}, shutdown_cached_handles=lambda: None, _shutdown=False
    )
    monkeypatch.setattr(ray, "wait", lambda refs, **_: (refs, []) if ends else ([], refs))
    monkeypatch.setattr(head_monitor, "head_is_gone", lambda: not head)
    monkeypatch.setattr(server, "_SHUTDOWN_S", 0.0)
    server.shut_down(client)
    assert client._shutdown
    assert ("has not ended within" in caplog.text) is said


def test_each_long_poll_of_a_controller_can_be_stopped_before_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray would tell the user of a failed task, in one end of four."""
    stopped: list[str] = []
    own = SimpleNamespace(stop=lambda: stopped.append("own"))
    shared = SimpleNamespace(long_poll_client=SimpleNamespace(stop=lambda: stopped.append("shared")))
    monkeypatch.setattr(SharedRouterLongPollClient, "get_or_create", lambda *_: shared)
    used = SimpleNamespace(
        _router=SimpleNamespace(_asyncio_router=SimpleNamespace(long_poll_client=own, _event_loop=1))
    )
    unused = SimpleNamespace(_router=None)
    for poll in long_polls(SimpleNamespace(_controller=None, handle_cache={"used": used, "unused": unused})):
        poll.stop()
    assert stopped == ["own", "shared"]
