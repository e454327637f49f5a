"""A deployment's own settings change while it runs: new episodes get the new ones, running ones end on the old."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from eval_fakes import wait_for
from numbered_checkpoints import Library, act, ask, begin, reset

from vlagents_ray.errors import UnknownSession
from vlagents_ray.serve.engine.engine import Engine


@pytest.fixture
def library() -> Iterator[Library]:
    library = Library()
    yield library
    for gate in library.held.values():
        gate.set()


def swap(engine: Engine, checkpoint: str) -> None:
    engine.models.configure({"checkpoint": checkpoint})


def state(engine: Engine) -> Any:
    return engine.models.describe()["swap"]


def swapped(engine: Engine, checkpoint: str) -> None:
    swap(engine, checkpoint)
    wait_for(lambda: state(engine) is None and engine.models.config["checkpoint"] == checkpoint)


def test_running_episodes_end_on_the_old_checkpoint_and_new_ones_begin_on_the_new(library: Library) -> None:
    engine = library.engine()
    try:
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
    finally:
        engine.close()


def test_an_old_checkpoint_without_sessions_goes_at_once(library: Library) -> None:
    engine = library.engine()
    swapped(engine, "b/2")
    wait_for(lambda: library.closed == ["a/1"])
    engine.close()


def test_a_checkpoint_that_does_not_load_leaves_the_old_one_in_place(library: Library) -> None:
    engine = library.engine()
    try:
        reset(engine, "old")
        swap(engine, "broken")
        wait_for(lambda: state(engine) is not None and state(engine)["state"] == "failed")
        assert state(engine)["error"].endswith("did not load: FileNotFoundError; the server's log says why")
        assert act(engine, "old") == [1, 1]
        assert reset(engine, "new") == "a/1"
        swapped(engine, "b/2")
        assert reset(engine, "new") == "b/2"
    finally:
        engine.close()


def test_a_swap_that_failed_is_forgotten_with_the_old_settings(library: Library) -> None:
    engine = library.engine()
    try:
        swap(engine, "broken")
        wait_for(lambda: state(engine) is not None and state(engine)["state"] == "failed")
        engine.models.configure({"checkpoint": "a/{step}", "checkpoint_step": 1})
        assert state(engine) is None
    finally:
        engine.close()


def test_the_last_word_counts(library: Library) -> None:
    engine = library.engine()
    try:
        gate = library.hold("b/2")
        swap(engine, "b/2")
        library.wait_for("b/2")
        swap(engine, "c/3")
        gate.set()
        wait_for(lambda: reset(engine, "s") == "c/3")
        wait_for(lambda: set(library.alive) == {"c/3"})
    finally:
        engine.close()


def test_choices_are_laid_over_the_new_settings(library: Library) -> None:
    engine = library.engine(steps=True)
    try:
        assert reset(engine, "s", checkpoint_step=5) == "a/5"
        engine.models.configure({"checkpoint": "b/{step}", "checkpoint_step": 2})
        wait_for(lambda: reset(engine, "s", checkpoint_step=5) == "b/5")
        assert reset(engine, "t") == "b/2"
    finally:
        engine.close()


def test_with_room_for_one_sessions_end_so_that_the_new_one_can_load(library: Library) -> None:
    engine = library.engine(loaded=1)
    try:
        gate = library.hold("b/2")
        reset(engine, "old")
        swap(engine, "b/2")
        library.wait_for("b/2")
        assert library.closed == ["a/1"]
        assert "a/1" not in library.alive, "two would not have been in memory together"
        with pytest.raises(UnknownSession):
            act(engine, "old")
        waiting = begin(engine, "old")
        gate.set()
        reply = waiting.get(timeout=10)
        assert reply.info is not None
        assert reply.info["checkpoint"] == "b/2"
    finally:
        engine.close()


@pytest.mark.parametrize("op", ["act", "reset"])
def test_what_a_swap_overtakes_is_told_that_its_session_has_ended(library: Library, op: str) -> None:
    """Clients begin such an episode again by themselves; a closed policy must not be asked."""
    engine = library.engine()
    try:
        reset(engine, "s")
        [model] = engine.models._cache.loaded.values()

        class Overtaken:
            """The lock, which the swap gets first."""

            def __enter__(self) -> None:
                model.busy = threading.Lock()
                engine.sessions.close_those_of(model)
                model.close()

            def __exit__(self, *_: object) -> None: ...

        model.busy = Overtaken()  # type: ignore[assignment]
        before = len(library.batches)
        assert isinstance(ask(engine, "s", op).get(timeout=10).error, UnknownSession)
        assert len(library.batches) == before
    finally:
        engine.close()


def test_with_room_for_one_the_old_one_is_loaded_again_if_the_new_one_cannot_be(library: Library) -> None:
    engine = library.engine(loaded=1)
    try:
        swap(engine, "broken")
        wait_for(lambda: state(engine) is not None and state(engine)["state"] == "failed")
        assert reset(engine, "s") == "a/1"
        assert library.loads["a/1"] == 2
    finally:
        engine.close()


def test_a_third_waits_for_the_episodes_on_the_first(library: Library) -> None:
    engine = library.engine()
    try:
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
    finally:
        engine.close()


def test_replicas_with_different_settings_have_different_versions(library: Library) -> None:
    here, there = library.engine(), library.engine()
    assert here.version == there.version
    swapped(here, "b/2")
    assert here.version != there.version
    swapped(there, "b/2")
    assert here.version == there.version
    here.close()
    there.close()


def test_a_swap_without_room_takes_that_of_a_choice(library: Library) -> None:
    engine = library.engine(choices=["c/3"])
    try:
        reset(engine, "own")
        reset(engine, "chosen", checkpoint="c")
        gate = library.hold("b/2")
        swap(engine, "b/2")
        wait_for(lambda: engine.models._cache.draining != "")
        again = begin(engine, "chosen", checkpoint="c")  # its last episode is over: the room goes to the swap
        library.wait_for("b/2")
        assert reset(engine, "another") == "a/1"
        gate.set()
        wait_for(lambda: state(engine) is None)
        for session in ("own", "another"):  # the last that kept the old one in memory
            ask(engine, session, "close").get(timeout=10)
        assert reset(engine, "own") == "b/2"
        assert again.get(timeout=10).error is None
        assert act(engine, "chosen") == [3, 1]
    finally:
        engine.close()
