"""The time at which Serve considers a replica running: after its policy has loaded, not before, and
not if loading failed.
"""

from __future__ import annotations

import asyncio
import threading
import traceback
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from ray import serve
from ray._common.utils import import_attr
from ray.serve._private.api import call_user_app_builder_with_args_if_necessary
from ray.serve.exceptions import RayServeException

from vlagents_ray.errors import MessageTooLarge, MissingDependency, PolicyFailed, PolicyUnavailable
from vlagents_ray.serve.access.key_store import new_key
from vlagents_ray.serve.app import application
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import IMPORT_PATH
from vlagents_ray.serve.ports import HOST
from vlagents_ray.serve.replica import replica as module
from vlagents_ray.serve.replica.replica import PolicyReplica
from vlagents_ray.serve.scaling.rebalancer import Rebalancer
from vlagents_ray.serve.scaling.session_migration import HeldSessions
from vlagents_ray.serve.scaling.sibling_replicas import PEER_METHODS


class Bare(PolicyReplica):
    """A replica that Serve has not created, and that has nothing to close."""

    def __del__(self) -> None:  # type: ignore[override]
        pass


def replica(start: Any) -> Bare:
    """Return a replica with only the attributes that its start uses."""
    engine: Any = SimpleNamespace(start=start)
    one = object.__new__(Bare)
    vars(one).update(
        _args=ServerArgs(policy="noop"),
        _engine=engine,
        _configured=False,
        _gateway=None,
        _peers=SimpleNamespace(announce_this_replica=lambda: asyncio.sleep(0)),
        _rebalancer=SimpleNamespace(run=lambda: asyncio.sleep(0)),
        _parts=SimpleNamespace(before_ready=lambda: asyncio.sleep(0), run=lambda: asyncio.sleep(0)),
        _watch_shutdown=lambda: asyncio.sleep(0),
        _report_changes=lambda: asyncio.sleep(0),
    )
    return one


def test_a_replica_runs_when_its_policy_has_loaded() -> None:
    loaded = threading.Event()

    async def start() -> list[bool]:
        one = replica(lambda _: loaded.wait(60))
        running = asyncio.ensure_future(one.reconfigure({}, None))
        await asyncio.wait({running}, timeout=0.3)
        before = running.done()
        loaded.set()
        await running
        await asyncio.gather(*one._tasks)
        return [before, running.done()]

    assert asyncio.run(start()) == [False, True]


def test_a_replica_runs_when_its_parts_have_prepared_for_the_loaded_policy() -> None:
    events: list[str] = []

    class Parts:
        async def before_ready(self) -> None:
            events.append("prepares")
            await asyncio.sleep(0.05)
            events.append("has prepared")

        async def run(self) -> None:
            events.append("works")

    async def start() -> None:
        one = replica(lambda _: events.append("policy is loaded"))
        vars(one).update(_parts=Parts())
        await one.reconfigure({}, None)
        events.append("is ready")
        await asyncio.gather(*one._tasks)

    asyncio.run(start())
    assert events == ["policy is loaded", "prepares", "has prepared", "is ready", "works"]


@pytest.mark.parametrize(
    ("cause", "shown"), [(MissingDependency("no jax"), False), (KeyError("jax"), True)]
)
def test_only_the_traceback_of_a_policys_own_bug_is_shown(
    cause: Exception, shown: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """`serve status` shows a raised exception with its traceback, in which the cause would be hard
    to find.
    """

    def fail(_: object) -> None:
        raise PolicyFailed("the policy did not load: no jax") from cause

    one = replica(fail)
    with pytest.raises(PolicyFailed, match="the policy did not load: no jax") as failed:
        asyncio.run(one.reconfigure({}, None))
    lines = traceback.format_exception(failed.value)
    assert ("direct cause" in "".join(lines)) == shown
    assert ("in fail" in "".join(lines)) == shown
    assert ("in fail" in caplog.text) != shown, "the cause is in exactly one of the two"


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (
            {"environment": {"python": "/nowhere/.venv-pi/bin/python"}},
            "ConfigError: environment.python: expected an interpreter",
        ),
        ({"batch": {"max_sise": 3}}, "batch.max_sise"),
    ],
)
def test_serve_status_shows_one_sentence_if_an_application_cannot_be_built(
    args: dict[str, Any], said: str
) -> None:
    """Serve shows only the text of its own exceptions, but a traceback of forty lines for any other
    exception.
    """
    builder = import_attr(IMPORT_PATH)
    with pytest.raises(RayServeException) as failed:
        call_user_app_builder_with_args_if_necessary(builder, {"policy": "noop"} | args)
    assert said in str(failed.value)
    assert len(str(failed.value).splitlines()) == 1
    built = call_user_app_builder_with_args_if_necessary(builder, {"policy": "noop", "replicas": 2})
    assert built._bound_deployment.num_replicas == 2


@pytest.mark.parametrize("act_s", [3.0, 60.0, 600.0])
def test_serve_leaves_a_replica_that_does_not_answer_as_much_time_as_a_call_may_take(
    act_s: float,
) -> None:
    """The policy may hold the GIL meanwhile. Only Serve's checks limit this time."""
    policy = application(ServerArgs(policy="noop", limits={"act_s": act_s}))._bound_deployment
    assert policy._deployment_config.max_constructor_retry_count == 2, (
        "Serve must start a second replica, as the first may have been killed while it loaded"
    )
    silent_s = 3 * policy._deployment_config.health_check_timeout_s
    assert act_s <= silent_s <= max(15.0, act_s)


@pytest.mark.parametrize("plain", [False, True])
def test_a_replica_warns_of_keys_that_come_unencrypted_unless_tls_ends_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, plain: bool
) -> None:
    new_key(tmp_path / "keys", "arm")
    everywhere = SimpleNamespace(host="0.0.0.0", ssl_certfile=None)  # noqa: S104 - an address that causes a warning
    monkeypatch.delenv(HOST, raising=False)
    monkeypatch.setattr(module, "http_options", lambda: everywhere)
    monkeypatch.setattr(module, "write_audit", lambda: None)
    monkeypatch.setattr(module, "check_replica", lambda: None)
    monkeypatch.setattr(module, "cluster_id", lambda: "a cluster")
    monkeypatch.setattr(serve, "get_replica_context", lambda: SimpleNamespace(app_name="noop"))

    def ended() -> None:
        raise RayServeException("this test starts no engine")

    monkeypatch.setattr(module, "SiblingReplicas", ended)
    access = {"keys_file": str(tmp_path / "keys"), "plain_http": plain}
    with pytest.raises(RayServeException, match="no engine"):
        asyncio.run(Bare.__init__(object.__new__(Bare), {"policy": "noop", "access": access}))
    assert ("host 0.0.0.0: API keys cross the network unencrypted" in caplog.text) == (not plain)


@pytest.mark.parametrize("method", PEER_METHODS)
def test_what_other_replicas_call_reaches_the_part_that_has_it(
    monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    asked = PEER_METHODS[method]
    parts = {part: SimpleNamespace() for part in (HeldSessions, Rebalancer)}

    async def later(part: object, *args: object) -> object:
        return part, args

    call = later if asked.part is HeldSessions else lambda part, *args: (part, args)
    monkeypatch.setitem(PEER_METHODS, method, asked._replace(call=call))
    one = object.__new__(Bare)
    vars(one).update(
        _migrator=SimpleNamespace(sessions=parts[HeldSessions]),
        _rebalancer=parts[Rebalancer],
    )
    args = () if asked.part is Rebalancer else (1, "two")
    part, given = asyncio.run(one.peer(method, *args))
    assert part is parts[asked.part]
    assert given == args


def test_other_replicas_call_a_part_by_its_name() -> None:
    class Parts:
        async def call(self, part: str, method: str, *args: Any) -> Any:
            return part, method, args

    one = object.__new__(Bare)
    vars(one).update(_parts=Parts())
    assert asyncio.run(one.call_part("counter", "count", 1, "two")) == (
        "counter",
        "count",
        (1, "two"),
    )


@pytest.mark.parametrize("method", ["call_part", *PEER_METHODS])
def test_an_error_for_another_replica_is_returned(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Serve logs a traceback of an error that is raised."""
    error = PolicyUnavailable("the policy is loading; try again")

    def fail(*args: Any) -> Any:
        raise error

    async def fail_later(*args: Any) -> Any:
        raise error

    replica = object.__new__(Bare)
    vars(replica).update(
        _parts=SimpleNamespace(call=fail_later),
        _migrator=SimpleNamespace(sessions=None),
        _rebalancer=None,
    )
    if method == "call_part":
        assert asyncio.run(replica.call_part("weights", "newest")) is error
        return
    asked = PEER_METHODS[method]
    failing = fail if asked.part is Rebalancer else fail_later
    monkeypatch.setitem(PEER_METHODS, method, asked._replace(call=failing))
    assert asyncio.run(replica.peer(method)) is error


@pytest.mark.parametrize("has_plasma", [True, False])
def test_an_error_for_a_plasma_client_is_returned(has_plasma: bool) -> None:
    error = MessageTooLarge("frame: expected at most 5 bytes, got 60")

    def fail(length: int) -> Any:
        raise error

    replica = object.__new__(Bare)
    plasma = SimpleNamespace(pool=SimpleNamespace(lease=fail)) if has_plasma else None
    vars(replica).update(_plasma=plasma)
    returned = asyncio.run(replica.lease(60))
    assert returned is error if has_plasma else isinstance(returned, PolicyUnavailable)


def test_a_replica_answers_what_waits_before_its_ways_in_and_its_parts_close() -> None:
    closed: list[str] = []

    def part(name: str, **more: Any) -> Any:
        return SimpleNamespace(close=lambda: closed.append(name), **more)

    async def ended(name: str) -> None:
        closed.append(name)

    async def close() -> None:
        one = object.__new__(Bare)
        vars(one).update(
            _tasks=[asyncio.ensure_future(asyncio.sleep(60))],
            _engine=part("engine", draining=True),
            _migrator=SimpleNamespace(
                hand_over=lambda: ended("sessions"), close=lambda: ended("migrator")
            ),
            **{
                f"_{name}": part(name)
                for name in ("parts", "metrics", "local", "stream", "websockets")
            },
            _plasma=None,
        )
        await one.close()
        assert await asyncio.gather(*one._tasks, return_exceptions=True)

    asyncio.run(close())
    assert closed == [
        "sessions",
        "migrator",
        "engine",
        "local",
        "stream",
        "websockets",
        "parts",
        "metrics",
    ]


def test_later_settings_replace_the_loaded_policy_before_the_replica_runs_again() -> None:
    """Serve sends no client to a replica until `reconfigure` returns, and replaces the replica if
    it raises an error.
    """
    configs: list[tuple[str, dict[str, Any]]] = []

    async def start() -> None:
        one = replica(lambda config: configs.append(("start", config)))
        vars(one)["_engine"].swap = lambda config: configs.append(("swap", config))
        await one.reconfigure(None, None)
        await asyncio.gather(*one._tasks)
        one._tasks = []
        await one.reconfigure({"checkpoint_step": 2}, None)
        assert one._tasks == [], "the periodic tasks run already"

    asyncio.run(start())
    assert configs == [("start", {}), ("swap", {"checkpoint_step": 2})]
