"""XPolicyLab's servers: one model with one state, and actions in several forms."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from upstream_servers import answer, pack_xpolicylab, upstream

from vlagents_ray.errors import ConfigError, MalformedMessage, UnknownSession, VLAgentsError
from vlagents_ray.interface import Obs
from vlagents_ray.policies.upstream import Upstream, xpolicylab
from vlagents_ray.serve.models.agent_copies import AgentCopies
from vlagents_ray.serve.ports import free_port

MAPPING = {
    "state": {"joints": "state/arm_joint_state"},
    "instruction": "instruction",
    "action": {"arm_joint_state": {"stop": 6}, "ee_joint_state": {"start": 6}},
}


def settings(*ports: int, **more: Any) -> dict[str, Any]:
    urls = [f"ws://127.0.0.1:{port}" for port in ports]
    return {"protocol": "xpolicylab", "urls": urls, "mapping": MAPPING, "connect_timeout_s": 60, **more}


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    found = free_port()
    with upstream("xpolicylab", found):
        yield found


def seen(number: int) -> Obs:
    return Obs(state={"joints": np.full(6, number, np.float32)})


def expected(obs: Obs, step: int) -> np.ndarray:
    theirs = {"data_format_version": "v1.0", "env_idx": 0, "instruction": "task"}
    return answer(theirs | {"state": {"arm_joint_state": obs.state["joints"]}}, step).astype(np.float32)


def test_each_episode_begins_with_a_reset_and_one_session_acts_at_a_time(port: int) -> None:
    with Upstream.from_config(settings(port)) as agent:
        agent.initialize()
        copies = AgentCopies(agent)
        for _ in range(2):  # the second session begins while the first is still there, as an episode after another
            session = copies.make()
            session.reset(seen(0), "task")
            for step in range(3):
                [act] = agent.act_batch([seen(step)], [session])
                assert not isinstance(act, Exception), act
                np.testing.assert_array_equal(act.action, expected(seen(step), step))
        newer = copies.make()
        newer.reset(seen(0), "task")
        ended, act = agent.act_batch([seen(0), seen(0)], [session, newer])
        assert isinstance(ended, UnknownSession)
        assert "another session began at an upstream that keeps one" in str(ended)
        np.testing.assert_array_equal(act.action, expected(seen(0), 0))


def test_sessions_of_a_model_with_a_state_are_not_spread_over_servers() -> None:
    with pytest.raises(ConfigError, match="its server keeps one session"):
        Upstream.from_config(settings(9, 10))
    Upstream.from_config(settings(9, 10, sessions="none"))


ROWS = np.arange(14, dtype=np.float32).reshape(2, 7)
NAMED = {"arm": ROWS[:, :6], "hand": ROWS[:, 6:]}


@pytest.mark.parametrize(
    ("actions", "found"),
    [
        (ROWS, ROWS),
        (list(ROWS), ROWS),
        (ROWS.tolist(), ROWS),
        (ROWS[0], ROWS[0]),
        (ROWS[0].tolist(), ROWS[0]),
        ([{"arm": row[:6], "hand": row[6:]} for row in ROWS], NAMED),
        ([{"arm": row[:6].tolist(), "hand": float(row[6])} for row in ROWS], NAMED),
        (NAMED, NAMED),
    ],
)
def test_actions_are_read_in_each_form_that_its_policies_answer(actions: Any, found: Any) -> None:
    reply = xpolicylab.read_reply(
        pack_xpolicylab({"message_type": "infer_result", "message_id": "1", "payload": {"actions": actions}})
    )
    read = xpolicylab.read_actions(reply.payload)
    if isinstance(found, dict):
        assert isinstance(read, dict)
        assert list(read) == list(found)
        for name in found:
            np.testing.assert_array_equal(read[name], found[name])
    else:
        np.testing.assert_array_equal(read, found)


@pytest.mark.parametrize(
    ("actions", "says"),
    [
        (None, "got NoneType, want arrays"),
        ("left", "got str, want arrays"),
        ([], r"got \[\], want the same in each step"),
        (["left"], "got str, want arrays"),
        ([{"arm": ROWS[0]}, {"hand": ROWS[0]}], "the same names in each step"),
        ([{"arm": ROWS[0]}, {"arm": ROWS[0, :3]}], "want the same in each step"),
        ([{"arm": None}], "got NoneType, want arrays"),
        ([{1: ROWS[0]}], "got the name 1, want text|keys"),
    ],
)
def test_actions_of_another_form_are_refused(actions: Any, says: str) -> None:
    with pytest.raises(MalformedMessage, match=says):
        xpolicylab.read_actions({"actions": actions})


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x80\x04\x95\x10cos\nsystem\n",
        pack_xpolicylab([1]),
        pack_xpolicylab({"message_type": "infer_result", "message_id": 1, "payload": {}}),
        pack_xpolicylab({"message_type": "infer_result", "message_id": "1", "payload": []}),
        pack_xpolicylab({"payload": {b"nd": True, b"type": "|O", b"kind": b"O", b"shape": (1,), b"data": b"12345678"}}),
    ],
)
def test_a_reply_that_is_none_is_an_error_of_ours(data: bytes) -> None:
    with pytest.raises(VLAgentsError):
        xpolicylab.read_reply(data)
