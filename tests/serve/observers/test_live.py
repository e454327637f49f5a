"""What is kept for viewers, and that nothing is while nobody looks."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from manual_clock import Clock
from observed import observe

from vlagents_ray.images.codecs import DecodedFiles
from vlagents_ray.interface import Act, Obs
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.observer import Observers
from vlagents_ray.serve.observers.live import LEASE_S, RATE, LiveObserver

IMAGE = np.zeros((4, 4, 3), np.uint8)


class Watched:
    """A live observer at a clock that stands, and the engine's watchers."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.observers = Observers()
        self.live = LiveObserver(self.observers, clock=self.clock)
        self.replies: list[Reply] = []

    def ask(self, session: str, obs: Obs | None, op: str = "act", files: DecodedFiles | None = None) -> None:
        self.replies.append(Reply(act=Act(np.zeros(2, np.float32))))
        observe(self.live, session, Request(op, obs), self.replies[-1], files)  # type: ignore[arg-type]


@pytest.fixture
def watched() -> Watched:
    return Watched()


def test_it_is_the_engines_only_while_somebody_looks(watched: Watched) -> None:
    assert watched.observers.any is False
    watched.live.renew()
    assert watched.observers.any
    watched.clock.now += LEASE_S * 0.9
    watched.live.renew()
    watched.clock.now += LEASE_S * 0.9
    watched.live.expire()
    assert watched.observers.any
    watched.clock.now += LEASE_S
    watched.live.expire()
    assert watched.observers.any is False


def test_answers_are_kept_in_order(watched: Watched) -> None:
    watched.live.renew()
    watched.ask("a", Obs())
    watched.ask("b", Obs(), "reset")
    first, second = watched.live.answers(0)
    assert (first.session, first.op, second.session, second.op) == ("a", "act", "b", "reset")
    assert watched.live.answers(first.number) == [second]


def test_observations_are_kept_ten_times_a_second_at_most(watched: Watched) -> None:
    for gripper in (0.1, 0.2):
        watched.ask("a", Obs(gripper=gripper))
    watched.ask("b", Obs(gripper=0.3))
    kept = [watched.live.observation(name) for name in "ab"]
    assert [float(one.state["gripper"][0]) for one in kept if one is not None] == pytest.approx([0.1, 0.3])
    watched.clock.now += 1.01 / RATE
    watched.ask("a", Obs(gripper=0.4))
    assert float(watched.live.observation("a").state["gripper"][0]) == pytest.approx(0.4)  # type: ignore[union-attr]


def test_states_are_copies_since_their_client_wants_its_memory_back(watched: Watched) -> None:
    joints = np.ones(7, np.float32)
    watched.ask("a", Obs(state={"joints": joints}))
    joints[:] = 0
    assert watched.live.observation("a").state["joints"].sum() == 7  # type: ignore[union-attr]


def test_a_file_is_kept_in_place_of_its_pixels_unless_the_policy_gets_others(watched: Watched) -> None:
    turned = IMAGE[::-1].copy()
    files: DecodedFiles = {id(IMAGE): (IMAGE, memoryview(b"jpeg"))}
    watched.ask("a", Obs(cameras={"front": IMAGE, "wrist": turned}), files=files)
    seen = watched.live.observation("a")
    assert seen is not None
    assert seen.files == {"front": b"jpeg"}
    assert list(seen.cameras) == ["wrist"]


def test_pictures_that_nobody_reads_are_let_go(watched: Watched) -> None:
    class Memory(np.ndarray):
        """An array to which weak references can be made."""

    image = np.zeros((4, 4, 3), np.uint8).view(Memory)
    gone = weakref.ref(image)
    watched.live.renew()
    watched.ask("a", Obs(cameras={"front": image}))
    del image
    assert gone() is not None
    for _ in range(2):
        watched.clock.now += LEASE_S * 0.6
        watched.live.renew()
        watched.live.expire()
    gc.collect()
    assert gone() is None


def test_sessions_that_ended_are_forgotten(watched: Watched) -> None:
    for session in "ab":
        watched.ask(session, Obs(gripper=1.0))
    watched.live.forget_others(["b", "c"])
    assert watched.live.observation("a") is None
    assert watched.live.observation("b") is not None
