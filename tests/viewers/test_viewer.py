"""A viewer never delays the control loop, whatever happens to its disk or to the receiver; and a
run of the loop with a viewer.
"""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.robot import LoopOptions, run_loop
from vlagents_ray.robot.simulated import SimulatedRobot
from vlagents_ray.viewers import EpisodeViewer, LoopView, ViewerFrame

FRAMES = 8


class Slow:
    """A target that writes nothing until `go` is set."""

    target, closing_s = "nowhere", None

    def __init__(
        self, *, broken_at: int | None = None, going: bool = True, closing_s: float | None = None
    ) -> None:
        self.go = threading.Event()
        self.taken = threading.Event()  # a frame is being written
        self.broken_at = broken_at
        self.closing_s = closing_s
        self.episodes: list[tuple[str, str]] = []
        self.written: list[int] = []
        self.closed = 0  # number of closed episodes
        if going:
            self.go.set()

    def begin(self, name: str, instruction: str) -> Slow:
        self.episodes.append((name, instruction))
        return self

    def write(self, frame: ViewerFrame) -> None:
        self.taken.set()
        assert self.go.wait(60)
        if frame.tick == self.broken_at:
            raise OSError("no space left")
        self.written.append(frame.tick)

    def close(self) -> None:
        self.closed += 1


def test_frames_beyond_the_queue_are_dropped_and_counted_and_none_waits() -> None:
    target = Slow(going=False)
    with EpisodeViewer(target, frames=FRAMES) as viewer:
        with viewer.episode("one"):
            viewer.add(ViewerFrame(0, 0.0))
            assert target.taken.wait(60)
            # The writer is blocked. If `add` waited for it, the test would hang.
            for tick in range(1, 1000):
                viewer.add(ViewerFrame(tick, 0.0))
            assert not viewer.has_room
            target.go.set()
        assert viewer.dropped == 1000 - FRAMES
    assert target.written == list(range(FRAMES))


def test_every_frame_of_an_episode_is_written_in_order_before_it_is_closed() -> None:
    target = Slow()
    with EpisodeViewer(target, frames=1000) as viewer:
        for name in ("one", "two"):
            with viewer.episode(name, "stack"):
                for tick in range(50):
                    viewer.add(ViewerFrame(tick, 0.0))
    assert target.episodes == [("one", "stack"), ("two", "stack")]
    assert target.written == [*range(50), *range(50)]
    assert target.closed == 2
    assert (viewer.episodes, viewer.dropped, viewer.error) == (2, 0, None)


def test_an_error_ends_what_is_shown_of_an_episode_and_the_next_one_is_shown(
    caplog: pytest.LogCaptureFixture,
) -> None:
    target = Slow(broken_at=3)
    with EpisodeViewer(target, frames=1000) as viewer:
        with viewer.episode("one"):
            for tick in range(6):
                viewer.add(ViewerFrame(tick, 0.0))
        with viewer.episode("two"):
            viewer.add(ViewerFrame(7, 0.0))
    assert target.written == [0, 1, 2, 7]
    assert (viewer.episodes, str(viewer.error)) == (1, "no space left")
    assert "episode one is not shown: no space left" in caplog.text
    assert "stopped by OSError: no space left" in viewer.report()
    assert viewer.has_room


def test_an_episode_that_cannot_be_closed_does_not_take_the_next_one_with_it() -> None:
    class Unclosable(Slow):
        def close(self) -> None:
            super().close()
            if self.closed == 1:
                raise OSError("no space left")

    target = Unclosable()
    with EpisodeViewer(target) as viewer:
        for name in ("one", "two"):
            with viewer.episode(name):
                viewer.add(ViewerFrame(0, 0.0))
    assert (target.written, viewer.episodes, str(viewer.error)) == ([0, 0], 1, "no space left")


def test_the_end_of_a_live_viewer_that_takes_nothing_more_is_not_waited_for() -> None:
    target = Slow(going=False, closing_s=0.05)
    viewer = EpisodeViewer(target)
    with viewer.episode("one"):
        viewer.add(ViewerFrame(0, 0.0))
    begun = time.monotonic()
    viewer.close()
    assert time.monotonic() - begun < 30
    assert isinstance(viewer.error, TimeoutError)
    target.go.set()


def test_a_frame_is_a_copy_of_the_observation() -> None:
    image, joints = np.full((4, 4, 3), 7, np.uint8), np.ones(2, np.float32)
    frame = ViewerFrame.from_obs(
        Obs({"front": image}, 0.25, {"joints": joints}, {"captured_at": 5.0}), 3
    )
    image[:], joints[:] = 0, 0
    assert (frame.tick, frame.time) == (3, 5.0)
    assert frame.cameras["front"].min() == 7
    assert {name: part.tolist() for name, part in frame.state.items()} == {
        "joints": [1, 1],
        "gripper": [0.25],
    }


HZ, ROWS, CHUNKS = 100.0, 4, 3


class Counting(Agent):
    """A policy with chunks whose rows are numbered."""

    contract = Contract(action=ActionSpec(dim=2, delta=False), chunk=ROWS)
    asked = 0

    def act(self, obs: Obs) -> Act:
        first = ROWS * self.asked
        self.asked += 1
        rows = np.stack([np.arange(first, first + ROWS), np.zeros(ROWS)], axis=1)
        return Act(rows.astype(np.float32), info={"timing": {"round_trip_ms": 2.5}})


class Kept:
    """A target that stores its frames."""

    target, closing_s = "here", None

    def __init__(self) -> None:
        self.frames: list[ViewerFrame] = []

    def begin(self, name: str, instruction: str) -> Kept:
        return self

    def write(self, frame: ViewerFrame) -> None:
        self.frames.append(frame)

    def close(self) -> None:
        pass


def run(viewer: EpisodeViewer) -> None:
    agent = Counting()
    player = ChunkPlayer(agent, PlayerSettings(mode="open_loop"))
    robot = SimulatedRobot(agent.contract)
    run_loop(
        robot,
        player,
        hz=HZ,
        instruction="count",
        until=lambda: agent.asked > CHUNKS,
        options=LoopOptions(viewer=viewer),
    )


def test_each_tick_is_shown_with_what_was_planned_and_executed() -> None:
    target = Kept()
    with EpisodeViewer(target) as viewer:
        run(viewer)
    frames = target.frames
    assert len(frames) == CHUNKS * ROWS + 1
    executed = [float(frame.executed[0]) for frame in frames]
    assert executed == list(range(len(frames)))
    assert [float(frame.planned[0]) for frame in frames] == executed
    begins = [i for i, frame in enumerate(frames) if frame.chunk is not None]
    assert begins == list(range(0, len(frames), ROWS))
    assert [frames[i].chunk[:, 0].tolist() for i in begins] == [
        [i, i + 1, i + 2, i + 3] for i in begins
    ]
    assert {frame.numbers["round_trip_ms"] for frame in frames} == {2.5}
    assert {frame.numbers["safe"] for frame in frames} == {0.0}
    assert all(frame.numbers["work_ms"] > 0 for frame in frames)
    ticks = [frame.tick for frame in frames]
    assert ticks == sorted(set(ticks))


def test_spells_without_the_policy_are_shown_with_their_reason_once() -> None:
    target, wanted = Kept(), np.array([3, 4], np.float32)
    acts = [
        Act(np.zeros(2, np.float32), info={"safe": "waiting for an answer"}),
        Act(np.zeros(2, np.float32), info={"safe": "waiting for an answer"}),
        Act(np.ones(2, np.float32), info={"intervention": True, "policy_action": wanted}),
        Act(np.ones(2, np.float32)),
    ]
    with EpisodeViewer(target) as viewer:
        view = LoopView(viewer)
        with view.episode("count"):
            for tick, act in enumerate(acts):
                stop = "no signal from the server" if tick == 3 else ""
                view.add(Obs(), act, None if stop else act.action, tick, 0.0, stop)
    shown = target.frames
    assert [frame.note for frame in shown] == [
        "waiting for an answer",
        "",
        "",
        "no signal from the server",
    ]
    spells = [
        [frame.numbers[name] for name in ("safe", "intervention", "stopped")] for frame in shown
    ]
    assert spells == [[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    assert [None if frame.planned is None else frame.planned.tolist() for frame in shown] == [
        None,
        None,
        [3, 4],
        None,
    ]
    assert shown[3].executed is None
