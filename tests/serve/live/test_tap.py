"""What is kept for viewers, and that nothing is while nobody looks."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from manual_clock import Clock

from vlagents_ray.chunking.execution import WATCHED
from vlagents_ray.images.codecs import DecodedFiles
from vlagents_ray.interface import Act, Obs
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.live.tap import LEASE_S, RATE, LiveTap

IMAGE = np.zeros((4, 4, 3), np.uint8)


class Watched:
    """A tap at a clock that stands, and what the engine has of it."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.shown: LiveTap | None = None
        self.tap = LiveTap(self._show, self.clock)
        self.replies: list[list[Reply]] = []

    def _show(self, tap: LiveTap | None) -> None:
        self.shown = tap

    def ask(self, session: str, obs: Obs | None, op: str = "act", files: DecodedFiles | None = None) -> None:
        request = Request(op, obs)  # type: ignore[arg-type]
        done = self.tap.note([session], [request], files or {}, self.replies.append)
        done([Reply(act=Act(np.zeros(2, np.float32)))])


@pytest.fixture
def watched() -> Watched:
    return Watched()


def test_it_is_the_engines_only_while_somebody_looks(watched: Watched) -> None:
    assert watched.shown is None
    watched.tap.renew()
    assert watched.shown is watched.tap
    watched.clock.now += LEASE_S * 0.9
    watched.tap.renew()
    watched.clock.now += LEASE_S * 0.9
    watched.tap.expire()
    assert watched.shown is watched.tap
    watched.clock.now += LEASE_S
    watched.tap.expire()
    assert watched.shown is None


def test_a_lease_that_ends_without_any_message_ends_too(watched: Watched) -> None:
    watched.tap.renew()
    watched.clock.now += LEASE_S
    watched.tap.expire()
    assert watched.shown is None


def test_answers_are_sent_first_and_kept_in_order(watched: Watched) -> None:
    watched.tap.renew()
    watched.ask("a", Obs())
    watched.ask("b", Obs(), "reset")
    assert len(watched.replies) == 2
    first, second = watched.tap.answers(0)
    assert (first.session, first.op, second.session, second.op) == ("a", "act", "b", "reset")
    assert watched.tap.answers(first.number) == [second]


def test_players_are_told_of_viewers_and_of_nothing_else_that_reads(watched: Watched) -> None:
    """What they then state with each request costs half a millisecond over shared memory."""
    watched.tap.renew()
    watched.ask("a", Obs())
    watched.tap.renew(viewer=True)
    watched.ask("a", Obs())
    watched.ask("a", Obs())
    watched.clock.now += LEASE_S
    watched.tap.renew()
    watched.ask("a", Obs())
    told = [reply.act is not None and WATCHED in reply.act.info for [reply] in watched.replies]
    assert told == [False, True, False, False]


def test_unreadable_requests_are_kept_as_errors(watched: Watched) -> None:
    refused = Reply()
    watched.tap.note([""], [refused], {}, watched.replies.append)([refused])
    [answer] = watched.tap.answers(0)
    assert (answer.op, answer.session) == ("unknown", "")


def test_observations_are_kept_ten_times_a_second_at_most(watched: Watched) -> None:
    for gripper in (0.1, 0.2):
        watched.ask("a", Obs(gripper=gripper))
    watched.ask("b", Obs(gripper=0.3))
    kept = [watched.tap.seen(name) for name in "ab"]
    assert [float(one.state["gripper"][0]) for one in kept if one is not None] == pytest.approx([0.1, 0.3])
    watched.clock.now += 1.01 / RATE
    watched.ask("a", Obs(gripper=0.4))
    assert float(watched.tap.seen("a").state["gripper"][0]) == pytest.approx(0.4)  # type: ignore[union-attr]


def test_states_are_copies_since_their_client_wants_its_memory_back(watched: Watched) -> None:
    joints = np.ones(7, np.float32)
    watched.ask("a", Obs(state={"joints": joints}))
    joints[:] = 0
    assert watched.tap.seen("a").state["joints"].sum() == 7  # type: ignore[union-attr]


def test_a_file_is_kept_in_place_of_its_pixels_unless_the_policy_gets_others(watched: Watched) -> None:
    turned = IMAGE[::-1].copy()
    files: DecodedFiles = {id(IMAGE): (IMAGE, memoryview(b"jpeg"))}
    watched.ask("a", Obs(cameras={"front": IMAGE, "wrist": turned}), files=files)
    seen = watched.tap.seen("a")
    assert seen is not None
    assert seen.files == {"front": b"jpeg"}
    assert list(seen.cameras) == ["wrist"]


def test_pictures_that_nobody_reads_are_let_go(watched: Watched) -> None:
    class Memory(np.ndarray):
        """An array to which weak references can be made."""

    image = np.zeros((4, 4, 3), np.uint8).view(Memory)
    gone = weakref.ref(image)
    watched.tap.renew()
    watched.ask("a", Obs(cameras={"front": image}))
    del image
    assert gone() is not None
    for _ in range(2):
        watched.clock.now += LEASE_S * 0.6
        watched.tap.renew()
        watched.tap.expire()
    gc.collect()
    assert gone() is None


def test_sessions_that_ended_are_forgotten(watched: Watched) -> None:
    for session in "ab":
        watched.ask(session, Obs(gripper=1.0))
    watched.tap.forget_others(["b", "c"])
    assert watched.tap.seen("a") is None
    assert watched.tap.seen("b") is not None
