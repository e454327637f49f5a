"""The size limit of a reply, which the server checks before it copies or encodes any of it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from in_flight import pending

from vlagents_ray.errors import PolicyFailed
from vlagents_ray.interface import Act, Obs
from vlagents_ray.protocol.frames import decode_replies, encode_replies
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Reply, Request
from vlagents_ray.serve.config.deployment import LimitArgs
from vlagents_ray.serve.engine import responses
from vlagents_ray.serve.engine.responses import (
    build_reply,
    public_error,
    raised_at,
    require_serializable,
)
from vlagents_ray.serve.queue.call_limits import CallLimits
from vlagents_ray.serve.sessions import Session

LIMIT = 1000
INFO_LIMIT = LIMIT - 4  # the limit minus an action of one number


def large(nbytes: int) -> np.ndarray:
    """Return an array that takes no memory until it is copied."""
    return np.broadcast_to(np.float32(0), nbytes // 4)


def nested_list(levels: int) -> list[Any]:
    """Return lists nested in lists, `levels` deep."""
    return [nested_list(levels - 1)] if levels > 1 else [0]


def replied(act: Act) -> tuple[Reply, Session]:
    session = Session("s")
    return build_reply(pending("s", Request("act", Obs())), session, act, None, LIMIT), session


@pytest.mark.parametrize(
    "act",
    [
        Act(large(LIMIT + 4)),
        Act([0.0] * (LIMIT // 4 + 1)),  # type: ignore[arg-type]
        Act(np.zeros(1), info={"video": large(LIMIT)}),
        Act(np.zeros(1), info={"a": {"b": [bytearray(LIMIT // 2), "x" * LIMIT]}}),
    ],
    ids=["action", "list", "array", "nested"],
)
def test_an_act_over_the_limit_fails_and_is_not_counted(act: Act) -> None:
    reply, session = replied(act)
    assert isinstance(reply.error, PolicyFailed)
    assert "expected at most" in str(reply.error)
    assert (reply.act, session.steps) == (None, 0)


@pytest.mark.parametrize(
    "act",
    [
        Act(np.zeros(LIMIT // 4, np.float32)),
        Act([0.0] * (LIMIT // 4)),  # type: ignore[arg-type]
        Act(np.zeros(1), info={"video": np.zeros(INFO_LIMIT, np.uint8)}),
        Act(np.zeros(1), info={"text": "x" * INFO_LIMIT}),
        Act(np.zeros(1), info={"bytes": bytes(INFO_LIMIT)}),
        Act(np.zeros(1), info={"a": [bytes(INFO_LIMIT // 2), {"b": "x" * (INFO_LIMIT // 2)}]}),
        # The dict and the list also count as values.
        Act(np.zeros(1), info={"list": [0] * (DEFAULT_LIMITS.items - 2)}),
        Act(np.zeros(1), info={"deep": nested_list(DEFAULT_LIMITS.depth - 1)}),
    ],
    ids=["action", "list", "array", "text", "bytes", "several", "values", "depth"],
)
def test_an_act_of_exactly_the_limit_is_sent_and_read(act: Act) -> None:
    reply, session = replied(act)
    assert reply.error is None
    assert session.steps == 1

    [read] = decode_replies(encode_replies([reply]))
    assert read.error is None
    np.testing.assert_equal(read.act.info, reply.act.info)


def test_no_info_may_be_said_with_none() -> None:
    session = Session("s")
    ticket = pending("s", Request("act", Obs()))
    act = Act(np.zeros(1), info=None)  # type: ignore[arg-type]
    reply = build_reply(ticket, session, act, None, LIMIT, {"policy": {"version": 1}})
    assert reply.act.info == {"policy": {"version": 1}}


def test_sessions_to_which_a_policy_gives_one_info_have_each_their_own() -> None:
    """Data that the server adds to one answer, such as a command to that robot, is in no other
    answer.
    """
    shared = {"batch_ms": 1.0}
    (one, _), (other, _) = (
        replied(Act(np.zeros(1), info=shared)),
        replied(Act(np.zeros(1), info=shared)),
    )
    one.act.info["command"] = "stop"
    assert other.act.info == shared == {"batch_ms": 1.0}


def test_nothing_of_what_is_too_large_is_copied_or_looked_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(responses, "check_action", lambda *_: pytest.fail("looked at"))
    monkeypatch.setattr(np, "ascontiguousarray", lambda *_: pytest.fail("copied"))
    replied(Act(large(2**40)))
    with pytest.raises(PolicyFailed):
        require_serializable({"array": large(2**40).T})


@pytest.mark.parametrize(
    ("info", "said"),
    [
        ({"list": [0] * 10_000}, "more than 10000 values"),
        ({"a": [[[[[[[[0]]]]]]]]}, "nested deeper than 8"),
    ],
)
def test_what_no_client_would_read_is_refused_where_it_was_made(
    info: dict[str, Any], said: str
) -> None:
    with pytest.raises(PolicyFailed, match=said):
        require_serializable(info)


def test_a_deployment_sets_the_limits() -> None:
    assert LimitArgs(body_bytes=2000).limits().body_bytes == 2000
    assert LimitArgs(act_s=1, warm_up_s=2, load_s=3).call_limits() == CallLimits(1, 2, 3)


def test_an_error_in_this_process_names_no_server() -> None:
    ticket = pending("s", Request("act", Obs()))
    assert str(public_error(RuntimeError("x"), ticket)).endswith(
        "the policy raised RuntimeError; its process wrote the traceback to stderr"
    )


@pytest.mark.parametrize("fail", [lambda: json.loads("{"), lambda: np.linalg.inv(np.zeros((2, 2)))])
def test_an_error_that_a_library_raised_names_the_line_of_the_caller(
    fail: Callable[[], Any],
) -> None:
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - both libraries raise this type
        fail()
    assert re.fullmatch(r" \(test_responses\.py:\d+\)", raised_at(caught.value))
