"""The driver notices the loss of the cluster's head before Ray ends the driver."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import ray

from vlagents_ray.errors import ClusterLost
from vlagents_ray.ray_tools import head_monitor
from vlagents_ray.ray_tools.head_monitor import HeadMonitor
from vlagents_ray.ray_tools.private import node_of_this_process


@pytest.fixture
def silent(monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """Replace the head's socket by a bound one, so that no other process gets its port; it answers
    once it listens.
    """
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        context = SimpleNamespace(gcs_address=f"127.0.0.1:{bound.getsockname()[1]}")
        monkeypatch.setattr(ray, "get_runtime_context", lambda: context)
        monkeypatch.setattr(head_monitor, "PERIOD_S", 0.0)
        yield bound


def test_a_head_that_is_silent_for_a_while_is_waited_for(
    silent: socket.socket, caplog: pytest.LogCaptureFixture
) -> None:
    watched = HeadMonitor("continue with --resume")
    assert not watched.answers()
    assert not watched.answers()
    assert caplog.text.count("does not answer") == 1
    silent.listen()
    assert watched.answers()


@pytest.mark.usefixtures("silent")
def test_one_that_stays_silent_is_given_up_before_ray_ends_this_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("RAY_gcs_rpc_server_reconnect_timeout_s", "0.000001")
    watched = HeadMonitor("continue with --resume")
    with pytest.raises(ClusterLost, match=r"127\.0\.0\.1:\d+, has not answered.*--resume"):
        watched.answers()


@pytest.mark.usefixtures("silent")
def test_it_is_not_asked_at_every_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(head_monitor, "PERIOD_S", 3600.0)
    assert HeadMonitor("continue with --resume").answers()


@pytest.fixture
def node(silent: socket.socket, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> SimpleNamespace:
    """Return Ray's record of this machine, whose daemon listens when the test requests it; the head
    answers.
    """
    silent.listen()
    node = SimpleNamespace(raylet_socket_name=str(tmp_path / "raylet"))
    monkeypatch.setattr(head_monitor, "node_of_this_process", lambda: node)
    return node


def test_the_end_of_the_daemon_here_is_noticed_though_the_head_answers(
    node: SimpleNamespace,
) -> None:
    with socket.socket(socket.AF_UNIX) as daemon:
        daemon.bind(node.raylet_socket_name)
        daemon.listen()
        watched = HeadMonitor("continue with --resume")
        assert watched.answers()
    assert Path(node.raylet_socket_name).exists()  # the same state as after kill -9
    with pytest.raises(ClusterLost, match=r"raylet, has ended; continue with --resume"):
        watched.answers()


def test_a_head_that_this_process_started_is_not_waited_for(
    node: SimpleNamespace, silent: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = HeadMonitor("go on")
    monkeypatch.setattr(head_monitor, "started_here", lambda: True)
    own = HeadMonitor("go on")
    silent.close()
    later = head_monitor.monotonic() + 3
    monkeypatch.setattr(head_monitor, "monotonic", lambda: later)
    assert not watched.answers()
    with pytest.raises(ClusterLost, match="has not answered for 3 s"):
        own.answers()


def test_a_process_that_is_still_being_connected_has_no_node_yet(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ray has its record earlier, and would start a second Ray for any call at that time."""
    worker = SimpleNamespace(node="a node", connected=False)
    monkeypatch.setattr("ray._private.worker.global_worker", worker)
    assert node_of_this_process() is None
    worker.connected = True
    assert node_of_this_process() == "a node"
