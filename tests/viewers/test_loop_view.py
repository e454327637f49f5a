"""A run of the control loop in viewers."""

from __future__ import annotations

import numpy as np

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.robot import run_loop
from vlagents_ray.robot.simulated import SimulatedRobot
from vlagents_ray.viewers import EpisodeViewer, LoopView, ViewerFrame

HZ, ROWS, CHUNKS = 100.0, 4, 3


class Counting(Agent):
    """Chunks whose rows are numbered through."""

    contract = Contract(action=ActionSpec(dim=2, delta=False), chunk=ROWS)
    asked = 0

    def act(self, obs: Obs) -> Act:
        first = ROWS * self.asked
        self.asked += 1
        rows = np.stack([np.arange(first, first + ROWS), np.zeros(ROWS)], axis=1)
        return Act(rows.astype(np.float32), info={"timing": {"round_trip_ms": 2.5}})


class Kept:
    """A target that keeps its frames."""

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
    run_loop(robot, player, hz=HZ, instruction="count", viewer=viewer, until=lambda: agent.asked > CHUNKS)


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
    assert [frames[i].chunk[:, 0].tolist() for i in begins] == [[i, i + 1, i + 2, i + 3] for i in begins]
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
    assert [frame.note for frame in shown] == ["waiting for an answer", "", "", "no signal from the server"]
    spells = [[frame.numbers[name] for name in ("safe", "intervention", "stopped")] for frame in shown]
    assert spells == [[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    assert [None if frame.planned is None else frame.planned.tolist() for frame in shown] == [None, None, [3, 4], None]
    assert shown[3].executed is None
