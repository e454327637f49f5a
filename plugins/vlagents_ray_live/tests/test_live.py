"""Tests of the data that are kept for viewers while there are any, and of the memory and disk that
clients can use in this way.
"""

from __future__ import annotations

import gc
import itertools
import threading
import time
import tracemalloc
import weakref
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from eval_fakes import Clock
from in_flight import opened

from vlagents_ray.datasets.writer import Dataset
from vlagents_ray.errors import InvalidInput, MessageTooLarge, Overloaded, StorageFailed
from vlagents_ray.images import jpeg_png
from vlagents_ray.interface import Act, Obs
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.messages import PRIORITIES, DecodedFiles, Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.observer import Observer, Observers
from vlagents_ray.serve.requests import IncomingMessage, PendingRequest
from vlagents_ray_live import live, live_view, ring, spans
from vlagents_ray_live.live import LEASE_S, RATE, LiveObserver
from vlagents_ray_live.live_view import ReplicaView
from vlagents_ray_live.ring import LiveConfig, Ring
from vlagents_ray_live.spans import RequestSpans

IMAGE = np.zeros((4, 4, 3), np.uint8)


def observe(
    observer: Observer,
    session: str,
    request: Request,
    reply: Reply,
    files: DecodedFiles | None = None,
) -> None:
    pending = PendingRequest(
        session, request, IncomingMessage("test"), PRIORITIES[request.priority], observer_data={}
    )
    pending.files = files or {}
    observer.on_request(pending)
    request.obs = None  # the engine does this once the policy has acted
    observer.before_answer(pending, reply)
    observer.on_answer(pending, reply)


class Watched:
    """A live observer with a clock that stands still, and the engine's observers."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.observers = Observers()
        self.live = LiveObserver(self.observers, clock=self.clock)
        self.replies: list[Reply] = []

    def ask(
        self, session: str, obs: Obs | None, op: str = "act", files: DecodedFiles | None = None
    ) -> None:
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
    assert [float(one.state["gripper"][0]) for one in kept if one is not None] == pytest.approx(
        [0.1, 0.3]
    )
    watched.clock.now += 1.01 / RATE
    watched.ask("a", Obs(gripper=0.4))
    assert float(watched.live.observation("a").state["gripper"][0]) == pytest.approx(0.4)  # type: ignore[union-attr]


def test_states_are_copies_since_their_client_wants_its_memory_back(watched: Watched) -> None:
    joints = np.ones(7, np.float32)
    watched.ask("a", Obs(state={"joints": joints}))
    joints[:] = 0
    assert watched.live.observation("a").state["joints"].sum() == 7  # type: ignore[union-attr]


def test_a_file_is_kept_in_place_of_its_pixels_unless_the_policy_gets_others(
    watched: Watched,
) -> None:
    turned = IMAGE[::-1].copy()
    files: DecodedFiles = {id(IMAGE): (IMAGE, memoryview(b"jpeg"))}
    watched.ask("a", Obs(cameras={"front": IMAGE, "wrist": turned}), files=files)
    seen = watched.live.observation("a")
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


# Limits

LARGE = 2**20  # size of a part of a message, bytes; a server accepts up to 64 MiB
BUDGET = 2**21  # limit of each kind of kept data, bytes
SLACK = 2**20  # allowance for all other memory, bytes

ObsAndReply = tuple[Obs, Reply]


def acted(**info: Any) -> Reply:
    return Reply(act=Act(np.zeros((2, 7), np.float32), info=info))


def small_image_of_a_large_message() -> ObsAndReply:
    pixels = np.frombuffer(bytes(LARGE), np.uint8)
    return Obs({"front": pixels[:192].reshape(8, 8, 3)}), acted()


MESSAGES: dict[str, Callable[[], ObsAndReply]] = {
    "a text in info": lambda: (Obs(info={"note": "x" * LARGE}), acted()),
    "a large state": lambda: (Obs(state={"joints": np.zeros(LARGE // 4, np.float32)}), acted()),
    "many parts of a state": lambda: (
        Obs(state={str(i): np.zeros(1, np.float32) for i in range(500)}),
        acted(),
    ),
    "a long name": lambda: (Obs(state={"x" * LARGE: np.zeros(1, np.float32)}), acted()),
    "a large image": lambda: (Obs({"front": np.zeros((512, 700, 3), np.uint8)}), acted()),
    "a small image of a large message": small_image_of_a_large_message,
    "a text of the policy": lambda: (Obs(), acted(note="x" * LARGE)),
    "a long name of the policy": lambda: (Obs(), acted(**{"x" * LARGE: 1})),
    "a number of the policy": lambda: (Obs(), acted(number=1 << (8 * LARGE))),
    "many entries of the policy": lambda: (Obs(), acted(**{str(i): "x" * 200 for i in range(500)})),
    "a long chunk": lambda: (Obs(), Reply(act=Act(np.zeros((2**12, 64), np.float32)))),
    "a wide action": lambda: (Obs(), Reply(act=Act(np.zeros((1, 2**18), np.float32)))),
    "a long error": lambda: (Obs(), Reply(error=InvalidInput("x" * LARGE))),
}


class Kept:
    """Measures how much the memory of Python and numpy has grown since the context began, bytes."""

    def __enter__(self) -> Kept:
        gc.collect()
        tracemalloc.start()
        self._before = tracemalloc.get_traced_memory()[0]
        return self

    def __exit__(self, *_: object) -> None:
        tracemalloc.stop()

    def bytes(self) -> int:
        gc.collect()
        return tracemalloc.get_traced_memory()[0] - self._before


@pytest.fixture
def budgets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "ANSWER_BYTES", BUDGET // 2)
    monkeypatch.setattr(live, "OBSERVATION_BYTES", BUDGET)


def send(
    watched: LiveObserver, session: str, message: ObsAndReply, files: DecodedFiles | None = None
) -> None:
    obs, reply = message
    observe(watched, session, Request("act", obs), reply, files)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*MESSAGES, "all in turn"])
def test_many_messages_of_the_largest_size_leave_bounded_memory_in_the_live_observer(
    budgets: None, kind: str
) -> None:
    clock, kinds = Clock(), itertools.cycle(MESSAGES if kind == "all in turn" else [kind])
    watched = LiveObserver(Observers(), clock=clock)
    watched.renew()
    with Kept() as kept:
        for number in range(200):
            send(watched, f"key/{number}", MESSAGES[next(kinds)]())
            if number % 20 == 0 and (seen := watched.observation(f"key/{number}")) is not None:
                seen.pictures()
        assert kept.bytes() < 1.5 * BUDGET + SLACK
        assert watched.answers(0)[-1].size < 2**17  # a part of each answer is kept
        clock.now += 10.0
        watched.expire()
        del seen
        assert kept.bytes() < SLACK
        assert watched.answers(0) == []


def test_the_files_of_observations_are_bounded_and_the_oldest_go_first(budgets: None) -> None:
    watched = LiveObserver(Observers(), clock=Clock())
    watched.renew()
    with Kept() as kept:
        for number in range(30):
            image = np.zeros((8, 8, 3), np.uint8)
            send(
                watched,
                str(number),
                (Obs({"front": image}), acted()),
                {id(image): (image, memoryview(bytes(LARGE)))},
            )
        assert kept.bytes() < 1.5 * BUDGET + SLACK
    assert watched.observation("0") is None
    assert watched.observation("29") is not None


def test_a_snapshot_and_what_is_sent_of_it_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_view, "PICTURES", BUDGET)
    engine = Engine(Noop.from_config({}))
    view = ReplicaView(
        engine,
        "this",
        "here",
        lambda: {"policy": "", "checkpoint": "", "weights": None, "policy_version": None},
    )
    names = [str(number) for number in range(10)]
    view.live.renew()
    for name in names:
        opened(engine.sessions, name)
        image = np.zeros((8, 8, 3), np.uint8)
        send(
            view.live,
            name,
            (Obs({"front": image}), acted()),
            {id(image): (image, memoryview(bytes(LARGE)))},
        )
    pictured: set[str] = set()
    for _ in range(6):
        found = view.read(0, names)
        assert 0 < sum(map(len, found.files)) <= BUDGET
        pictured |= {one["id"] for one in found.document["sessions"] if one["pictures"]}
    assert pictured == set(names)  # pictures are sent in turns
    view.close()


class Tracer:
    """A tracer that is never called."""


@pytest.mark.library("opentelemetry")
def test_requests_that_wait_for_their_spans_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spans, "each_half_second", SimpleNamespace(add=lambda _: None))
    traced = RequestSpans(Tracer(), "this")
    with Kept() as kept:
        for kind in sorted(MESSAGES) * 3:
            obs, reply = MESSAGES[kind]()
            obs.info["traceparent"] = "x" * LARGE
            observe(traced, "s", Request("act", obs), reply)
            del obs, reply
        assert kept.bytes() < SLACK


FILE = jpeg_png.encode_jpeg(np.zeros((1024, 1024, 3), np.uint8), 60, "420")


class Saves:
    """A ring that holds frames of one session, "s"."""

    def __init__(self, folder: Path, frames: int, **options: Any) -> None:
        self.folder = folder
        self.settings = LiveConfig(folder=str(folder), **options)
        self.clock = clock = Clock()
        clock.now = time.monotonic()
        self.watched = LiveObserver(Observers(), clock=clock)
        sessions: Any = SimpleNamespace(ids=lambda: ["s"], all=list)
        self.ring = Ring(self.watched, sessions, folder, self.settings, "r")
        image = np.zeros((8, 8, 3), np.uint8)
        for _ in range(frames):
            files: DecodedFiles = {id(image): (image, memoryview(FILE))}
            send(self.watched, "s", (Obs({"front": image}), acted()), files)
            self.ring.read()
            clock.now += 1.05 / live.RATE


@pytest.fixture(scope="module")
def saves(tmp_path_factory: pytest.TempPathFactory) -> Saves:
    return Saves(tmp_path_factory.mktemp("kept") / "kept", 12)


@pytest.mark.parametrize(
    "kind", ["a large state", "a large image", "a small image of a large message", "a wide action"]
)
def test_the_ring_holds_no_more_than_its_memory(tmp_path: Path, kind: str) -> None:
    held = Saves(tmp_path, 0, memory_mb=2)
    with Kept() as kept:
        for _ in range(20):
            send(held.watched, "s", MESSAGES[kind]())
            held.ring.read()
            held.clock.now += 1.05 / live.RATE
        # The ring's frames, and the last observation in the live observer.
        assert kept.bytes() < 2e6 + 2 * LARGE + SLACK
        assert held.ring.bytes <= 2e6


def test_a_save_decodes_one_frame_at_a_time(saves: Saves) -> None:
    tracemalloc.start()
    try:
        saves.ring.save("s")
        # The memory of a few of the twelve pictures.
        assert tracemalloc.get_traced_memory()[1] < 4 * 3 * 2**20
    finally:
        tracemalloc.stop()


def test_one_session_is_saved_at_a_time(saves: Saves, monkeypatch: pytest.MonkeyPatch) -> None:
    entered, go_on = threading.Event(), threading.Event()
    begin = Dataset.begin

    def waits(*args: Any) -> Any:
        entered.set()
        go_on.wait(30)
        return begin(*args)

    monkeypatch.setattr(Dataset, "begin", waits)
    first = threading.Thread(target=saves.ring.save, args=("s",))
    first.start()
    assert entered.wait(30)
    with pytest.raises(Overloaded, match="press again"):
        saves.ring.save("s")
    go_on.set()
    first.join()
    saves.ring.save("s")


def test_nothing_is_saved_into_a_full_folder(tmp_path: Path) -> None:
    small = Saves(tmp_path, 2, most_gb=1e-9)
    small.ring.save("s")
    with pytest.raises(StorageFailed, match=r"expected at most 1e-09 GB, got .*; make room there"):
        small.ring.save("s")


def test_a_save_that_fails_leaves_no_files_and_the_next_one_works(
    saves: Saves, monkeypatch: pytest.MonkeyPatch
) -> None:
    decode, files = ring.decode, iter(range(100))

    def fails(file: bytes, most: int) -> np.ndarray:
        return decode(file, most if next(files) < 4 else 0)  # fails at the fourth frame

    monkeypatch.setattr(ring, "decode", fails)
    with pytest.raises(MessageTooLarge):
        saves.ring.save("s")
    monkeypatch.undo()
    assert [list(folder.iterdir()) for folder in saves.folder.rglob("unfinished")] == [[]]
    saves.ring.save("s")
