"""The driver notices that the cluster's head is gone, before Ray ends the driver for it."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
import ray

from vlagents_ray.errors import ClusterLost
from vlagents_ray.evaluate import head
from vlagents_ray.evaluate.head import Head


@pytest.fixture
def silent(monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """In place of the head's socket: bound, so that nobody else gets its port, and answering once it listens."""
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        context = SimpleNamespace(gcs_address=f"127.0.0.1:{bound.getsockname()[1]}")
        monkeypatch.setattr(ray, "get_runtime_context", lambda: context)
        monkeypatch.setattr(head, "PERIOD_S", 0.0)
        yield bound


def test_a_head_that_is_silent_for_a_while_is_waited_for(
    silent: socket.socket, caplog: pytest.LogCaptureFixture
) -> None:
    watched = Head()
    assert not watched.answers()
    assert not watched.answers()
    assert caplog.text.count("does not answer") == 1
    silent.listen()
    assert watched.answers()


@pytest.mark.usefixtures("silent")
def test_one_that_stays_silent_is_given_up_before_ray_ends_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_gcs_rpc_server_reconnect_timeout_s", "0.000001")
    watched = Head()
    with pytest.raises(ClusterLost, match=r"127\.0\.0\.1:\d+, has not answered.*--resume"):
        watched.answers()


@pytest.mark.usefixtures("silent")
def test_it_is_not_asked_at_every_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(head, "PERIOD_S", 3600.0)
    assert Head().answers()
