"""Sessions select among the checkpoints of a deployment, whose default checkpoint can be swapped:
loading, sharing and eviction.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from in_flight import checked, submit
from in_process_replicas import export
from numbered_checkpoints import Library, act, ask, begin, reset

from vlagents_ray import Agent, Obs
from vlagents_ray.errors import (
    CheckpointFailed,
    DeadlineExceeded,
    InvalidObservation,
    PolicyFailed,
    PolicyUnavailable,
    UnknownCheckpoint,
    UnknownSession,
)
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.policies.base.checkpoint_files import digest
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.models import model_manager
from vlagents_ray.serve.requests import PendingRequest
from vlagents_ray.serve.sessions import Session


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


def holders(engine: Engine) -> dict[str | None, int]:
    """Return the number of sessions of each checkpoint."""
    return {model.checkpoint: model.sessions for model in engine.models._cache.loaded.values()}


def test_sessions_act_by_the_checkpoint_that_they_chose(serving: Callable[..., Engine]) -> None:
    engine = serving(choices=["b/2"], steps=True, loaded=3)
    assert reset(engine, "own") == "a/1"
    chosen = begin(engine, "chosen", checkpoint="b", seed=4).get(timeout=10)
    assert chosen.info == {"checkpoint": "b/2", "options": {"seed": 4}}, (
        "the policy does not receive the choice"
    )
    assert reset(engine, "step", checkpoint_step=30) == "a/30"
    for step in range(1, 20):
        assert [act(engine, name) for name in ("own", "chosen", "step")] == [
            [1, step],
            [2, step],
            [30, step],
        ]


def test_a_batch_is_run_checkpoint_by_checkpoint(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(choices=["b/2"])
    for i in range(4):
        reset(engine, f"s{i}", checkpoint="b" if i % 2 else None)
    replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
    tickets = [checked(engine, f"s{i}", Request("act", Obs()), replies.put) for i in range(4)]
    engine.queue.put(*tickets)
    numbers = sorted(float(replies.get(timeout=10).act.action[0]) for _ in range(4))  # type: ignore[union-attr]
    assert numbers == [1, 1, 2, 2]
    assert sorted(library.batches) == [("a/1", ["a/1", "a/1"]), ("b/2", ["b/2", "b/2"])]


@pytest.mark.parametrize(
    ("offer", "options", "says"),
    [
        ({"choices": ["b/2"]}, {"checkpoint": "/etc/passwd"}, r"one of \['b'\]"),
        ({"choices": ["b/2"]}, {"checkpoint": ["b"]}, r"one of \['b'\]"),
        ({"choices": ["b/2"]}, {"checkpoint_step": 3}, r"one of \['b'\]"),
        ({"steps": True}, {"checkpoint": "b"}, "a checkpoint_step"),
        ({"steps": True}, {"checkpoint_step": -1}, "a number of training steps"),
        ({"steps": True}, {"checkpoint_step": True}, "a number of training steps"),
        ({"steps": True}, {"checkpoint_step": "../../b"}, "a number of training steps"),
        ({}, {"checkpoint": "b"}, "expected none, as there is only one"),
    ],
)
def test_what_is_not_offered_is_refused_with_what_is(
    serving: Callable[..., Engine], offer: dict[str, Any], options: dict[str, Any], says: str
) -> None:
    engine = serving(**offer)
    with pytest.raises(UnknownCheckpoint, match=says):
        begin(engine, "s", **options)
    assert engine.sessions.ids() == []


def test_loading_one_checkpoint_keeps_no_session_of_another_waiting(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(choices=["b/2"])
    gate = library.hold("b/2")
    reset(engine, "own")
    waiting = [begin(engine, f"chosen {i}", checkpoint="b") for i in range(8)]
    library.wait_for("b/2")
    assert [act(engine, "own")[1] for _ in range(200)] == list(range(1, 201))
    assert reset(engine, "another") == "a/1"
    assert waiting[0].empty()
    gate.set()
    assert [replies.get(timeout=10).error for replies in waiting] == [None] * 8
    assert act(engine, "chosen 0") == [2, 1]
    assert library.loads["b/2"] == 1, "loaded once for all sessions"


def test_what_does_not_load_says_why_and_is_tried_again(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(choices=["broken"])
    reset(engine, "own")
    for tried in (1, 2):
        with pytest.raises(
            CheckpointFailed, match="checkpoint 'b' did not load: FileNotFoundError; the server"
        ):
            reset(engine, "chosen", checkpoint="b")
        assert library.loads["broken"] == tried
    assert act(engine, "own") == [1, 1]
    assert engine.models.describe()["loaded"] == ["a/1"]


def test_the_least_recently_used_checkpoint_makes_room(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(choices=["b/2", "c/3"])
    reset(engine, "s", checkpoint="b")
    reset(engine, "s")  # the default checkpoint is now the last used
    reset(engine, "s", checkpoint="c")
    assert library.closed == ["b/2"]
    assert sorted(engine.models.describe()["loaded"]) == ["a/1", "c/3"]


def test_memory_is_given_back(serving: Callable[..., Engine], library: Library) -> None:
    engine = serving(choices=["b/2"], loaded=1, batch_sizes=[4], max_batch_size=4)
    reset(engine, "s")
    act(engine, "s")  # padding also keeps agents
    reset(engine, "s", checkpoint="b")
    assert library.closed == ["a/1"]
    assert set(library.alive) == {"b/2"}


def test_a_checkpoint_in_use_stays_until_an_episode_ends(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(choices=["b/2", "c/3"])
    reset(engine, "own")
    reset(engine, "chosen", checkpoint="b")
    waiting = begin(engine, "third", checkpoint="c")
    for step in range(1, 50):
        assert [act(engine, "own"), act(engine, "chosen")] == [[1, step], [2, step]]
    assert waiting.empty()
    assert library.closed == []
    ask(engine, "chosen", "close")
    assert waiting.get(timeout=10).error is None
    assert library.closed == ["b/2"]


def test_a_checkpoint_that_does_not_fit_into_memory_waits_for_another_to_leave(
    serving: Callable[..., Engine],
    library: Library,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    engine = serving(choices=["b/2", "c/3"], loaded=3)
    size, total = 10, 25  # room for two checkpoints

    def memory(_: object) -> dict[str, int]:
        reserved = size * len(library.alive)
        return {"allocated": reserved, "reserved": reserved, "free": total - reserved}

    monkeypatch.setattr(model_manager, "gpu_memory", memory)
    reset(engine, "own")
    reset(engine, "chosen", checkpoint="b")
    waiting = begin(engine, "third", checkpoint="c")
    assert [act(engine, "own"), act(engine, "chosen")] == [[1, 1], [2, 1]]
    assert waiting.empty()
    ask(engine, "chosen", "close")
    assert waiting.get(timeout=10).error is None
    assert library.closed == ["b/2"]
    assert (
        caplog.text.count(
            "the next checkpoint waits until one of the 2 loaded checkpoints leaves the GPU"
        )
        == 1
    )
    assert "'reserved': 20, 'free': 5} bytes; set checkpoints: {loaded: 2}" in caplog.text


def test_ten_checkpoints_have_their_turns_with_room_for_two(
    serving: Callable[..., Engine], library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten clients, each with a different checkpoint, begin one episode after the other
    without end.
    """
    monkeypatch.setattr(model_manager, "PATIENCE_S", 0.0)
    engine = serving(steps=True)
    replies: queue.SimpleQueue[tuple[int, Reply]] = queue.SimpleQueue()

    def play(client: int) -> None:
        request = Request("reset", Obs(), kwargs={"checkpoint_step": client})
        submit(engine, f"s{client}", request, lambda reply: replies.put((client, reply)))

    for client in range(10):
        play(client)
    turns = dict.fromkeys(range(10), 0)
    while min(turns.values()) < 3:
        client, reply = replies.get(timeout=20)
        assert reply.info is not None, reply.error
        assert reply.info["checkpoint"] == f"a/{client}"
        turns[client] += 1
        play(client)
    assert len(library.alive) <= 3  # one of them may be in the middle of its eviction


def test_a_reset_whose_time_is_over_is_told_and_nothing_is_loaded_for_it(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(choices=["b/2"], loaded=1)
    reset(engine, "own")
    late = ask(engine, "late", "reset", kwargs={"checkpoint": "b"}, deadline_ms=50)
    assert isinstance(late.get(timeout=10).error, DeadlineExceeded)
    ask(engine, "own", "close")
    assert reset(engine, "own") == "a/1"
    assert library.loads["b/2"] == 0


def test_a_session_that_is_closed_while_it_waits_is_not_opened_again(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(choices=["b/2"])
    gate = library.hold("b/2")
    waiting = begin(engine, "s", checkpoint="b")
    library.wait_for("b/2")
    ask(engine, "s", "close").get(timeout=10)
    gate.set()
    assert isinstance(waiting.get(timeout=10).error, UnknownSession)
    assert engine.sessions.ids() == []
    assert not any(model.sessions for model in engine.models._cache.loaded.values())


def test_a_reset_that_waits_gives_way_to_the_next_one_of_its_session(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(choices=["b/2"])
    gate = library.hold("b/2")
    waiting = begin(engine, "s", checkpoint="b")
    library.wait_for("b/2")
    assert reset(engine, "s") == "a/1"
    assert act(engine, "s") == [1, 1]
    gate.set()
    assert waiting.get(timeout=10).error is not None
    assert reset(engine, "other", checkpoint="b") == "b/2"
    assert act(engine, "s") == [1, 2]
    assert holders(engine) == {"a/1": 1, "b/2": 1}


def test_a_reset_of_a_session_that_is_closed_and_begun_anew_does_not_touch_it(
    serving: Callable[..., Engine], library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = serving(choices=["b/2"])
    put = engine.queue.put

    def late(*tickets: PendingRequest) -> None:
        """Queue the other requests of the session just before its reset that waited."""
        monkeypatch.undo()
        others.extend(ask(engine, "s", op) for op in ("close", "reset"))
        put(*tickets)

    others: list[queue.SimpleQueue[Reply]] = []
    gate = library.hold("b/2")
    waiting = begin(engine, "s", checkpoint="b")
    library.wait_for("b/2")
    monkeypatch.setattr(engine.queue, "put", late)
    gate.set()
    assert isinstance(waiting.get(timeout=10).error, UnknownSession)
    assert [replies.get(timeout=10).error for replies in others] == [None] * 2
    assert act(engine, "s") == [1, 1]
    assert holders(engine) == {"a/1": 1, "b/2": 0}


def test_a_reset_that_is_given_up_once_its_checkpoint_is_there_keeps_none(
    serving: Callable[..., Engine], library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = serving(choices=["b/2"])
    put = engine.queue.put

    def given_up(*tickets: PendingRequest) -> None:
        for ticket in tickets:
            ticket.over = True
        put(*tickets)

    gate = library.hold("b/2")
    begin(engine, "s", checkpoint="b")
    library.wait_for("b/2")
    monkeypatch.setattr(engine.queue, "put", given_up)
    gate.set()
    wait_for(lambda: holders(engine) == {"a/1": 0, "b/2": 0})


def test_a_session_that_closes_while_it_arrives_keeps_no_checkpoint(
    serving: Callable[..., Engine], monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = serving(), serving()
    reset(here, "s")
    state = export(here, "s")
    assert state is not None
    enter = there.sessions.enter

    def closed_at_once(session: Session) -> None:
        enter(session)
        there.sessions.close(session.id)

    monkeypatch.setattr(there.sessions, "enter", closed_at_once)
    there.moves.adopt("s", state)
    assert holders(there) == {"a/1": 0}


def test_an_episode_that_could_not_begin_keeps_no_checkpoint(
    serving: Callable[..., Engine],
) -> None:
    engine = serving(choices=["b/2"], loaded=1)
    assert isinstance(
        begin(engine, "s", checkpoint="b", fail=True).get(timeout=10).error, PolicyFailed
    )
    assert reset(engine, "another") == "a/1"


def test_each_checkpoint_has_a_contract_of_its_own(
    serving: Callable[..., Engine], library: Library
) -> None:
    library.joints = {"a/1": 2, "b/2": 3}
    engine = serving(choices=["b/2"])
    two, three = ({"state": {"joints": np.zeros(n, np.float32)}} for n in (2, 3))
    chosen = {"checkpoint": "b"}
    assert ask(engine, "s", "reset", obs=two).get(timeout=10).error is None
    # This request arrives before checkpoint "b" is loaded.
    early = ask(engine, "t", "reset", obs=two, kwargs=chosen).get(timeout=10)
    assert isinstance(early.error, InvalidObservation)
    with pytest.raises(InvalidObservation):
        ask(engine, "t", "reset", obs=two, kwargs=chosen)
    assert ask(engine, "t", "reset", obs=three, kwargs=chosen).get(timeout=10).error is None
    with pytest.raises(InvalidObservation):
        ask(engine, "t", "act", obs=two)
    assert ask(engine, "t", "act", obs=three).get(timeout=10).error is None
    assert ask(engine, "s", "act", obs=two).get(timeout=10).error is None


def test_an_act_behind_a_reset_is_checked_against_the_checkpoint_that_the_reset_chose(
    serving: Callable[..., Engine], library: Library
) -> None:
    """When the act arrived, it was checked against the session's checkpoint at that time."""
    library.joints = {"a/1": 2, "b/2": 3}
    engine = serving(choices=["b/2"])
    two, three = (Obs(state={"joints": np.zeros(n, np.float32)}) for n in (2, 3))
    chosen = {"checkpoint": "b"}
    for name, obs, kwargs in (("s", two, {}), ("t", three, chosen)):
        begun = ask(engine, name, "reset", obs={"state": obs.state}, kwargs=kwargs)
        assert begun.get(timeout=10).error is None

    replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
    requests = [Request("reset", three, kwargs=chosen), Request("act", two)]
    engine.queue.put(*(checked(engine, "s", request, replies.put) for request in requests))
    assert replies.get(timeout=10).error is None
    assert isinstance(replies.get(timeout=10).error, InvalidObservation)
    assert library.batches == []
    assert ask(engine, "s", "act", obs={"state": three.state}).get(timeout=10).error is None


def test_a_stopping_replica_turns_away_who_waits(library: Library) -> None:
    engine = library.engine(choices=["b/2"], loaded=1)
    reset(engine, "own")
    waiting = begin(engine, "chosen", checkpoint="b")
    assert act(engine, "own") == [1, 1]
    engine.close()
    assert isinstance(waiting.get(timeout=10).error, PolicyUnavailable)
    assert library.closed == ["a/1"]


def test_a_session_that_moves_takes_its_checkpoint_along(
    serving: Callable[..., Engine], library: Library
) -> None:
    here, there = serving(choices=["b/2"]), serving(choices=["b/2"])
    elsewhere = serving(choices=["b/4"])
    reset(here, "s", checkpoint="b")
    act(here, "s")
    state = export(here, "s")
    assert state is not None
    with pytest.raises(UnknownSession):
        elsewhere.moves.adopt("s", state, timeout_s=10)
    assert elsewhere.models.describe()["loaded"] == ["a/1"], "the checkpoint is not offered there"
    with pytest.raises(UnknownSession, match="'b' is not loaded here"):
        there.moves.adopt("s", state)
    there.moves.adopt("s", state, timeout_s=10)
    assert act(there, "s") == [2, 2]
    assert library.loads["b/2"] == 2
    wait_for(lambda: not any(model.sessions for model in here.models._cache.loaded.values()))


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
        assert engine.models.weights is None
        engine.start()
        try:
            reply = begin(engine, "s").get(timeout=10)
            assert reply.info == {
                "weights": told["digest"],
                **({"revision": "c0ffee"} if own else {}),
            }
            assert engine.models.describe()["weights"] == [told]
            assert engine.models.weights == told
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
        assert engine.models.weights == {**expected, "statistics": agent.statistics}
        reply = begin(engine, "s").get(timeout=10)
        assert reply.error is None
        assert reply.info.get("weights") == expected["digest"]
    finally:
        engine.close()


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
        versions.append(engine.models.version)
        engine.close()
    assert versions[0] == versions[1] != versions[2]


# A deployment's default settings change while it runs: new episodes use the new settings, running
# episodes end with the old ones.


def swap(engine: Engine, checkpoint: str) -> None:
    engine.models.configure({"checkpoint": checkpoint})


def state(engine: Engine) -> Any:
    return engine.models.describe()["swap"]


def swapped(engine: Engine, checkpoint: str) -> None:
    swap(engine, checkpoint)
    wait_for(lambda: state(engine) is None and engine.models.config["checkpoint"] == checkpoint)


def test_running_episodes_end_on_the_old_checkpoint_and_new_ones_begin_on_the_new(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving()
    gate = library.hold("b/2")
    reset(engine, "old")
    swap(engine, "b/2")
    library.wait_for("b/2")
    assert state(engine) == {"state": "loading", "checkpoint": "b/2"}
    assert reset(engine, "early") == "a/1"
    gate.set()
    wait_for(lambda: state(engine) is None)
    assert reset(engine, "new") == "b/2"
    assert act(engine, "new") == [2, 1]
    assert [act(engine, "old") for _ in range(3)] == [[1, 1], [1, 2], [1, 3]]
    assert reset(engine, "early") == "b/2"
    assert library.closed == []
    assert reset(engine, "old") == "b/2"
    wait_for(lambda: library.closed == ["a/1"] and set(library.alive) == {"b/2"})


def test_a_checkpoint_that_does_not_load_leaves_the_old_one_in_place(
    serving: Callable[..., Engine],
) -> None:
    engine = serving()
    reset(engine, "old")
    swap(engine, "broken")
    wait_for(lambda: state(engine) is not None and state(engine)["state"] == "failed")
    assert state(engine)["error"].endswith(
        "did not load: FileNotFoundError; the server's log says why"
    )
    assert act(engine, "old") == [1, 1]
    assert reset(engine, "new") == "a/1"
    engine.models.configure({"checkpoint": "a/{step}", "checkpoint_step": 1})
    assert state(engine) is None, "the checkpoint was forgotten with the old settings"
    swapped(engine, "b/2")
    assert reset(engine, "new") == "b/2"


def test_the_last_word_counts(serving: Callable[..., Engine], library: Library) -> None:
    engine = serving()
    gate = library.hold("b/2")
    swap(engine, "b/2")
    library.wait_for("b/2")
    swap(engine, "c/3")
    gate.set()
    wait_for(lambda: reset(engine, "s") == "c/3")
    wait_for(lambda: set(library.alive) == {"c/3"})


def test_choices_are_laid_over_the_new_settings(serving: Callable[..., Engine]) -> None:
    engine = serving(steps=True)
    assert reset(engine, "s", checkpoint_step=5) == "a/5"
    engine.models.configure({"checkpoint": "b/{step}", "checkpoint_step": 2})
    wait_for(lambda: reset(engine, "s", checkpoint_step=5) == "b/5")
    assert reset(engine, "t") == "b/2"


def test_with_room_for_one_sessions_end_so_that_the_new_one_can_load(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(loaded=1)
    gate = library.hold("b/2")
    reset(engine, "old")
    swap(engine, "b/2")
    library.wait_for("b/2")
    assert library.closed == ["a/1"]
    assert "a/1" not in library.alive, "two checkpoints would not have fit in memory together"
    with pytest.raises(UnknownSession):
        act(engine, "old")
    waiting = begin(engine, "old")
    gate.set()
    reply = waiting.get(timeout=10)
    assert reply.info["checkpoint"] == "b/2"
    swap(engine, "broken")
    wait_for(lambda: state(engine) is not None and state(engine)["state"] == "failed")
    assert reset(engine, "s") == "b/2", (
        "the old checkpoint is loaded again if the new one cannot be loaded"
    )
    assert library.loads["b/2"] == 2


@pytest.mark.parametrize("op", ["act", "reset"])
def test_what_a_swap_overtakes_is_told_that_its_session_has_ended(
    serving: Callable[..., Engine], library: Library, op: str
) -> None:
    """Clients begin such an episode again automatically. A closed policy must not be called."""
    engine = serving()
    reset(engine, "s")
    [model] = engine.models._cache.loaded.values()

    class Overtaken:
        """A lock that the swap acquires first."""

        def __enter__(self) -> None:
            model.busy = threading.Lock()
            engine.sessions.close_those_of(model)
            model.close()

        def __exit__(self, *_: object) -> None: ...

    model.busy = Overtaken()  # type: ignore[assignment]
    before = len(library.batches)
    assert isinstance(ask(engine, "s", op).get(timeout=10).error, UnknownSession)
    assert len(library.batches) == before


def test_a_third_waits_for_the_episodes_on_the_first(serving: Callable[..., Engine]) -> None:
    engine = serving()
    reset(engine, "first")
    swapped(engine, "b/2")
    reset(engine, "second")
    swap(engine, "c/3")
    assert act(engine, "first") == [1, 1]
    assert act(engine, "second") == [2, 1]
    assert state(engine)["state"] == "loading"
    ask(engine, "first", "close")
    wait_for(lambda: state(engine) is None)
    assert act(engine, "second") == [2, 2]
    assert reset(engine, "third") == "c/3"


def test_replicas_with_different_settings_have_different_versions(
    serving: Callable[..., Engine],
) -> None:
    here, there = serving(), serving()
    assert here.models.version == there.models.version
    swapped(here, "b/2")
    assert here.models.version != there.models.version
    swapped(there, "b/2")
    assert here.models.version == there.models.version


def test_a_swap_without_room_takes_that_of_a_choice(
    serving: Callable[..., Engine], library: Library
) -> None:
    engine = serving(choices=["c/3"])
    reset(engine, "own")
    reset(engine, "chosen", checkpoint="c")
    gate = library.hold("b/2")
    swap(engine, "b/2")
    wait_for(lambda: engine.models._cache.draining != "")
    # The last episode of this choice is over, so the swap takes its room.
    again = begin(engine, "chosen", checkpoint="c")
    library.wait_for("b/2")
    assert reset(engine, "another") == "a/1"
    gate.set()
    wait_for(lambda: state(engine) is None)
    # These were the last sessions that kept the old checkpoint in memory.
    for session in ("own", "another"):
        ask(engine, session, "close").get(timeout=10)
    assert reset(engine, "own") == "b/2"
    assert again.get(timeout=10).error is None
    assert act(engine, "chosen") == [3, 1]
