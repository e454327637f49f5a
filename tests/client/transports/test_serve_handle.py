"""Errors of a broken Ray in a call through a Serve handle are infrastructure failures, never the
policy's.
"""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import ray
from ray import serve
from ray.exceptions import (
    ActorDiedError,
    LocalRayletDiedError,
    ObjectStoreFullError,
    OutOfDiskError,
    RayTaskError,
)

from vlagents_ray.client.transports import serve_handle
from vlagents_ray.client.transports.serve_handle import HandleTransport
from vlagents_ray.errors import ConnectionLost, PolicyUnavailable
from vlagents_ray.interface import Act, Obs
from vlagents_ray.protocol.frames import encode_replies
from vlagents_ray.protocol.messages import Reply, Request

REQUEST = Request("act", Obs(gripper=1.0), session="s", request_id="r")


def failing(error: Exception) -> Any:
    def fail(*_: object, **__: object) -> None:
        raise error

    return fail


@pytest.mark.parametrize("error", [ObjectStoreFullError("full"), OutOfDiskError("full")])
def test_a_frame_that_neither_store_nor_disk_has_room_for_is_not_sent(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(ray, "put", failing(error))
    with pytest.raises(PolicyUnavailable, match=r"\d+ bytes cannot be sent") as raised:
        HandleTransport("app").call([REQUEST], 1)
    assert not isinstance(raised.value, ConnectionLost), (
        "this error would mean that the call may have been executed"
    )


@pytest.mark.parametrize("error", [ActorDiedError(), LocalRayletDiedError()])
def test_an_answer_that_is_lost_with_its_node_is_a_lost_connection(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(ray, "put", lambda _: None)
    monkeypatch.setattr(serve_handle, "call_replica", lambda *_, **__: None)
    monkeypatch.setattr(ray, "get", failing(error))
    with pytest.raises(ConnectionLost, match=f"replica is gone \\({type(error).__name__}\\)"):
        HandleTransport("app").call([REQUEST], 1)


def test_a_replica_that_fails_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray, "put", lambda _: None)
    monkeypatch.setattr(serve_handle, "call_replica", lambda *_, **__: None)
    monkeypatch.setattr(
        ray, "get", failing(RayTaskError("call", "its traceback", ValueError("no such layout")))
    )
    with pytest.raises(ConnectionLost, match="the replica failed: no such layout"):
        HandleTransport("app").call([REQUEST], 1)


def test_a_frame_is_sent_again_with_the_pause_that_it_may_have_waited_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The replica has not executed the frame. The repeated frame tells it that its client still
    waits.
    """
    reply = encode_replies([Reply("r", act=Act(np.ones(2, np.float32)))])
    pauses: list[float] = []
    answers: Iterator[Any] = iter([7.5, reply, reply])
    monkeypatch.setattr(ray, "put", lambda _: "frame")
    monkeypatch.setattr(serve_handle, "call_replica", lambda *args, **_: pauses.append(args[-1]))
    monkeypatch.setattr(ray, "get", lambda *_, **__: next(answers))
    transport = HandleTransport("app")
    for _ in range(2):
        [answer] = transport.call([REQUEST], 5)
        assert answer.error is None
    assert pauses == [0.0, 7.5, 7.5]


class TestConnecting:
    @pytest.fixture(autouse=True)
    def in_a_cluster(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(ray, "is_initialized", lambda: True)

    def test_another_replica_is_chosen_in_place_of_one_that_is_gone(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        answers: Iterator[Any] = iter(
            [ConnectionLost("gone"), ConnectionLost("gone"), {"policy": "p"}]
        )

        def attach(self: HandleTransport, timeout_s: float) -> Any:
            answer = next(answers)
            if isinstance(answer, Exception):
                raise answer
            return answer

        monkeypatch.setattr(HandleTransport, "_attach", attach)
        assert HandleTransport("app").connect(30) == {"policy": "p"}

    def test_where_all_are_gone_the_time_limit_holds(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(HandleTransport, "_attach", failing(ConnectionLost("gone")))
        with pytest.raises(PolicyUnavailable, match="gone"):
            HandleTransport("app").connect(0.5)

    def test_one_that_hangs_is_not_waited_for_while_another_may_answer(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """`reset` connects with `connect_timeout_s`, a minute. In an earlier version, the replica
        that was tried first used up all of it.
        """
        cancelled: list[bool] = []
        result = Mock(side_effect=[TimeoutError, TimeoutError, ({"policy": "p"}, "replica")])
        attaching = SimpleNamespace(result=result, cancel=lambda: cancelled.append(True))
        attach = SimpleNamespace(remote=lambda *_: attaching)
        monkeypatch.setattr(serve, "get_app_handle", lambda _: SimpleNamespace(attach=attach))
        assert HandleTransport("app").connect(60) == {"policy": "p"}
        assert len(cancelled) == 2, "the abandoned calls to other replicas must be cancelled"
