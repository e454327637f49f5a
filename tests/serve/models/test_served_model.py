"""The one model of a replica: its identity, and its replacement by a model with other settings."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asgi_server import served
from eval_fakes import wait_for
from in_process_replicas import export
from numbered_checkpoints import Library, act, ask, begin, reset

from vlagents_ray import Act, Agent, Obs, RemoteAgent
from vlagents_ray.errors import (
    InvalidObservation,
    NoReplica,
    PolicyFailed,
    PolicyUnavailable,
    UnknownSession,
)
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.policies.base.checkpoint_files import digest
from vlagents_ray.policies.wrapper import Wrapper
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.models.loaded_model import PolicySource
from vlagents_ray.serve.queue.call_limits import CallLimits
from vlagents_ray.serve.sessions import Session
from vlagents_ray.serve.weights import Rest
from vlagents_ray.success import SUCCESS_FILE, Solved, SuccessCurve, write_curves


@pytest.fixture
def library() -> Library:
    return Library()


@pytest.fixture
def serving(library: Library) -> Iterator[Callable[..., Engine]]:
    engines: list[Engine] = []

    def serve(**options: Any) -> Engine:
        engines.append(library.engine(**options))
        return engines[-1]

    yield serve
    for gate in library.held.values():
        gate.set()
    for engine in engines:
        engine.close()


def swap(engine: Engine, checkpoint: str) -> None:
    engine.swap({"checkpoint": checkpoint})


class Swapping:
    """A swap on another thread."""

    def __init__(self, engine: Engine, checkpoint: str) -> None:
        self.error: Exception | None = None
        self._engine, self._checkpoint = engine, checkpoint
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            swap(self._engine, self._checkpoint)
        except Exception as error:  # noqa: BLE001 - `end` raises it
            self.error = error

    def end(self) -> None:
        self._thread.join(20)
        assert not self._thread.is_alive()
        if self.error is not None:
            raise self.error


@pytest.mark.parametrize("transport", ["http", "websocket"])
def test_a_client_that_begins_an_episode_during_a_swap_waits_for_its_end(
    serving: Callable[..., Engine], library: Library, transport: str
) -> None:
    engine = serving()
    gate = library.hold("b/2")
    about = {"policy": "p", "version": "0", "protocol": PROTOCOL_VERSION}
    app = AccessMiddleware(build_http_app(engine, lambda: about, DEFAULT_LIMITS), None, "app")
    url = "http://127.0.0.1"
    with served(app) as port, RemoteAgent(f"{url}:{port}", transport=transport) as agent:
        agent.reset(Obs(), "x")
        before = agent.act(Obs()).action
        swapping = Swapping(engine, "b/2")
        library.wait_for("b/2")
        threading.Timer(1.5, gate.set).start()
        agent.reset(Obs(), "x")
        assert not np.array_equal(agent.act(Obs()).action, before)
        swapping.end()


def test_a_swap_closes_the_old_model_before_it_loads_the_next_one(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(batch_sizes=[4], max_batch_size=4)
    gate = library.hold("b/2")
    reset(engine, "old")
    assert act(engine, "old") == [1, 1]  # the rows that pad the batch also keep agents
    swapping = Swapping(engine, "b/2")
    library.wait_for("b/2")

    assert library.closed == ["a/1"]
    assert "a/1" not in library.alive, "two checkpoints would not have fit in memory together"
    assert len(engine.sessions) == 0
    for op in ("reset", "act"):
        with pytest.raises(PolicyUnavailable, match="the policy is loading"):
            ask(engine, "old", op)
    with pytest.raises(PolicyUnavailable, match="the policy is loading"):
        engine.health.check()
    assert (engine.contract, engine.model.weights) == (None, None)

    gate.set()
    swapping.end()
    engine.health.check()
    with pytest.raises(UnknownSession):
        act(engine, "old")
    assert reset(engine, "new") == "b/2"
    assert act(engine, "new") == [2, 1]
    assert engine.model.checkpoint == "b/2"
    assert set(library.alive) == {"b/2"}


def test_the_policys_thread_loads_every_model(
    serving: Callable[..., Engine], library: Library
) -> None:
    """State of a thread that `initialize` sets also applies to the acts."""
    engine = serving()
    swap(engine, "b/2")
    assert library.threads == ["policy", "policy"]


def test_the_running_batch_ends_on_the_old_model(
    serving: Callable[..., Engine], library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = serving()
    reset(engine, "running")
    reset(engine, "waiting")
    begun, over = threading.Event(), threading.Event()
    model = engine.model.require_loaded()
    act_batch = model.agent.act_batch

    def slow(*arguments: Any) -> list[Act | Exception]:
        begun.set()
        assert over.wait(20)
        return act_batch(*arguments)

    monkeypatch.setattr(model.agent, "act_batch", slow, raising=False)
    running = ask(engine, "running", "act")
    assert begun.wait(20)
    waiting = [ask(engine, "waiting", op) for op in ("act", "reset")]
    swapping = Swapping(engine, "b/2")
    wait_for(lambda: not engine.health.ready)
    over.set()
    swapping.end()

    reply = running.get(timeout=10)
    assert reply.act is not None
    assert reply.act.action[0] == 1
    # No request reaches a model for which it was not sent.
    errors = [type(replies.get(timeout=10).error) for replies in waiting]
    assert set(errors) <= {NoReplica, UnknownSession, type(None)}
    assert library.loads == {"a/1": 1, "b/2": 1}
    assert [name for name, _ in library.batches if name == "b/2"] == []


def test_requests_that_wait_keep_no_memory_of_the_old_model(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(max_batch_size=1)
    gate = library.hold("b/2")
    for session in ("taken", "waiting"):
        reset(engine, session)
    with engine.weights.acting_lock:  # the policy's thread waits with the first act
        taken = ask(engine, "taken", "act")
        wait_for(lambda: engine.queue.depth() == 0)
        waiting = ask(engine, "waiting", "act")
        swapping = Swapping(engine, "b/2")
        wait_for(lambda: not engine.health.ready)
    library.wait_for("b/2")
    assert taken.get(timeout=10).act is not None
    error = waiting.get(timeout=10).error
    assert isinstance(error, PolicyUnavailable)
    assert "loading" in str(error)
    assert "a/1" not in library.alive
    gate.set()
    swapping.end()


def test_a_swap_of_an_engine_that_stops_ends_at_once(serving: Callable[..., Engine]) -> None:
    engine = serving()
    engine.stop(timeout_s=10)
    with pytest.raises(PolicyFailed, match="the replica is stopping"):
        swap(engine, "b/2")


def test_a_model_that_does_not_load_leaves_none_and_the_next_swap_recovers(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving()
    reset(engine, "old")
    with pytest.raises(PolicyFailed, match="did not load: FileNotFoundError: no such checkpoint"):
        swap(engine, "broken")
    with pytest.raises(PolicyFailed, match="did not load: FileNotFoundError: no such checkpoint"):
        engine.health.check()
    for op in ("reset", "act"):
        # Clients get no details, but may find another replica.
        with pytest.raises(PolicyUnavailable, match="did not load: FileNotFoundError; the server"):
            ask(engine, "old", op)
    assert engine.model.loaded is None
    assert set(library.alive) == set()

    swap(engine, "a/1")
    engine.health.check()
    assert reset(engine, "new") == "a/1"
    assert library.loads["a/1"] == 2


def test_a_model_that_does_not_load_in_time_has_failed(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(limits=CallLimits(load_s=0.3))
    library.hold("b/2")
    with pytest.raises(PolicyFailed, match=r"not loaded within 0.3 s"):
        swap(engine, "b/2")
    assert not engine.health.ready


def test_the_same_settings_load_nothing(serving: Callable[..., Engine], library: Library) -> None:
    engine = serving()
    reset(engine, "s")
    engine.swap({"checkpoint_step": 1, "checkpoint": "a/{step}"})
    assert act(engine, "s") == [1, 1]
    assert library.loads == {"a/1": 1}


def test_swaps_follow_each_other(serving: Callable[..., Engine], library: Library) -> None:
    engine = serving()
    gate = library.hold("b/2")
    first = Swapping(engine, "b/2")
    library.wait_for("b/2")
    second = Swapping(engine, "c/3")
    gate.set()
    first.end()
    second.end()
    assert reset(engine, "s") == "c/3"
    assert set(library.alive) == {"c/3"}


def test_an_engine_without_threads_swaps_on_the_callers_thread(library: Library) -> None:
    engine = Engine(
        PolicySource(library.make, {"checkpoint": "a/1"}), EngineSettings(threaded=False)
    )
    engine.start()
    swap(engine, "b/2")
    assert engine.model.checkpoint == "b/2"
    assert library.threads == [threading.current_thread().name] * 2
    assert set(library.alive) == {"b/2"}
    engine.close()


def test_a_policy_that_sleeps_is_woken_for_a_swap(serving: Callable[..., Engine]) -> None:
    engine = serving()
    engine.weights.rest(Rest("sleep", offload=False))
    swap(engine, "b/2")
    assert reset(engine, "s") == "b/2"
    assert act(engine, "s") == [2, 1]


def test_each_checkpoint_has_its_own_contract(
    serving: Callable[..., Engine], library: Library
) -> None:
    library.joints = {"a/1": 3, "b/2": 7}
    engine = serving()
    three, seven = ({"state": {"joints": np.zeros(n, np.float32)}} for n in (3, 7))
    assert ask(engine, "s", "reset", obs=three).get(timeout=10).error is None
    swap(engine, "b/2")
    with pytest.raises(InvalidObservation, match=r"expected shape \(7,\)"):
        ask(engine, "s", "reset", obs=three)
    assert ask(engine, "s", "reset", obs=seven).get(timeout=10).error is None
    assert ask(engine, "s", "act", obs=seven).get(timeout=10).error is None


@pytest.mark.parametrize("op", ["act", "reset"])
def test_a_request_that_a_swap_overtakes_gets_the_end_of_its_session(
    serving: Callable[..., Engine], library: Library, op: str
) -> None:
    """Clients begin such an episode again automatically. A closed policy must not be called."""
    engine = serving()
    reset(engine, "s")
    model = engine.model.require_loaded()

    class Overtaken:
        """A lock that the swap acquires first."""

        def __enter__(self) -> None:
            model.busy = threading.Lock()
            engine.sessions.close_all()
            model.close()

        def __exit__(self, *_: object) -> None: ...

    model.busy = Overtaken()  # type: ignore[assignment]
    before = len(library.batches)
    assert isinstance(ask(engine, "s", op).get(timeout=10).error, UnknownSession)
    assert len(library.batches) == before


def test_a_session_that_arrives_during_a_swap_is_refused(
    serving: Callable[..., Engine], monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = serving(), serving()
    reset(here, "s")
    state = export(here, "s")
    assert state is not None
    enter = there.sessions.enter

    def enter_after_swap(session: Session[Any]) -> None:
        swap(there, "b/2")
        enter(session)

    monkeypatch.setattr(there.sessions, "enter", enter_after_swap)
    with pytest.raises(UnknownSession, match="replaced by one with other settings"):
        there.moves.adopt("s", state)
    assert there.sessions.ids() == []


def test_a_session_does_not_move_to_a_replica_with_another_checkpoint(
    serving: Callable[..., Engine],
) -> None:
    here, there = serving(), serving()
    reset(here, "s")
    state = export(here, "s")
    assert state is not None
    swap(there, "b/2")
    with pytest.raises(UnknownSession, match="belongs to another version of the policy"):
        there.moves.adopt("s", state)
    assert there.sessions.ids() == []


def test_replicas_with_different_settings_have_different_versions(
    serving: Callable[..., Engine],
) -> None:
    here, there = serving(), serving()
    assert here.model.version == there.model.version
    swap(here, "b/2")
    assert here.model.version != there.model.version
    swap(there, "b/2")
    assert here.model.version == there.model.version


class Stored(Agent):
    """A policy that reads a file."""

    def __init__(self, file: Path, weights: dict[str, str | None] | None = None) -> None:
        self.file, self.weights_id = file, weights

    def initialize(self) -> None:
        find_checkpoint(str(self.file)).read_bytes()


class Computed(Agent):
    """A policy without files."""

    def __init__(self, weights: dict[str, str | None] | None) -> None:
        self.weights_id = weights


def test_what_is_loaded_is_told_by_its_digest_in_the_metadata_and_with_each_reset(
    tmp_path: Path,
) -> None:
    """The digest is that of the files that `find_checkpoint` found, or the one that the agent
    reports.
    """
    file = tmp_path / "weights.pt"
    file.write_bytes(b"1")
    mine: dict[str, str | None] = {"digest": "mine", "revision": "c0ffee"}
    for own, told in ((None, {"digest": digest([file]), "revision": None}), (mine, mine)):
        engine = Engine(Stored(file, own))
        assert engine.model.weights is None
        engine.start()
        try:
            reply = begin(engine, "s").get(timeout=10)
            assert reply.info == {
                "weights": told["digest"],
                **({"revision": "c0ffee"} if own else {}),
            }
            assert engine.model.weights == told
        finally:
            engine.close()


@pytest.mark.parametrize(
    ("weights", "expected"),
    [
        ({"digest": "mine", "revision": None}, {"digest": "mine", "revision": None}),
        (None, {"digest": None, "revision": None}),
    ],
    ids=["with a digest", "without a digest"],
)
def test_the_statistics_of_the_training_are_in_the_metadata_of_the_weights(
    weights: dict[str, str | None] | None, expected: dict[str, str | None]
) -> None:
    """Clients compare a robot with these statistics, whether or not the policy identifies its
    weights.
    """
    agent = Computed(weights)
    agent.statistics = {"action": {"min": [0.0], "max": [1.0]}}
    engine = Engine(agent)
    engine.start()
    try:
        assert engine.model.weights == {**expected, "statistics": agent.statistics}
        reply = begin(engine, "s").get(timeout=10)
        assert reply.error is None
        assert reply.info.get("weights") == expected["digest"]
    finally:
        engine.close()


def curve(weights: str | None) -> SuccessCurve:
    return SuccessCurve("tabletop", 20.0, "async", {}, {0: Solved(9, 10, 25.0)}, weights)


class Renamed(Wrapper):
    """A wrapper that changes nothing."""


def test_the_measured_success_of_a_checkpoint_is_in_the_metadata_of_its_weights(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "weights.pt"
    file.write_bytes(b"1")
    own = digest([file])

    def success(agent: Agent) -> Any:
        engine = Engine(agent)
        engine.start()
        try:
            return (engine.model.weights or {}).get("success")
        finally:
            engine.close()

    assert success(Stored(file)) is None
    write_curves(tmp_path, [curve(own), curve(None), curve("sampled-sha256:other")])
    assert success(Stored(file)) == [curve(own).to_json(), curve(None).to_json()]
    assert success(Stored(file, {"digest": "mine", "revision": None})) == [curve(None).to_json()]
    assert success(Renamed(Stored(file))) is None, "a wrapper may change the actions"

    # A file of the same name with other contents does not prevent that the policy is served.
    (tmp_path / SUCCESS_FILE).write_text("[]")
    assert success(Stored(file)) is None
    assert "measure them again" in caplog.text


def test_sessions_move_between_replicas_with_the_same_weights_only(tmp_path: Path) -> None:
    """A replica that started after training had overwritten the checkpoint has other weights with
    the same settings.
    """
    file = tmp_path / "weights.pt"
    versions = []
    for content in (b"1", b"1", b"2"):
        file.write_bytes(content)
        engine = Engine(Stored(file))
        engine.start()
        versions.append(engine.model.version)
        engine.close()
    assert versions[0] == versions[1] != versions[2]


def test_the_facts_of_a_model_stay_known_after_the_engine_is_closed(
    serving: Callable[..., Engine], library: Library
) -> None:
    """Parts of a replica close after the engine: a recording still writes its metadata."""
    library.joints = {"a/1": 3}
    engine = serving()
    contract = engine.contract
    assert contract is not None
    engine.close()
    engine.close()
    assert library.closed == ["a/1"], "closed once"
    assert (engine.contract, engine.model.checkpoint) == (contract, "a/1")
