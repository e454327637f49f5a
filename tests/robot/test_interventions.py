"""Interventions in the control loop: the delay of their start, the robot's actions, and the
recordings.
"""

from __future__ import annotations

import itertools
import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from eval_fakes import SimulatedTime, wait_for
from scripted_leader import ScriptedLeader

from vlagents_ray import Act, ActionSpec, Agent, ConfigError, Contract, Obs
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.robot import Guard, Watchdog, run_loop
from vlagents_ray.robot.record import Recorder
from vlagents_ray.robot.simulated import SimulatedRobot

HZ = 50.0
MAX_STEP = 0.05


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimulatedTime:
    clock = SimulatedTime()
    monkeypatch.setattr("vlagents_ray.robot.pacing.time", clock)
    return clock


class Going(Agent):
    """A policy that moves by 0.01 per tick from the robot's position."""

    contract = Contract(action=ActionSpec(dim=2, delta=False, low=-3.0, high=3.0))

    def act(self, obs: Obs) -> Act:
        return Act((obs.state["joints"] + 0.01 * np.arange(1, 5)[:, np.newaxis]).astype(np.float32))


class Arm(SimulatedRobot):
    """An arm that stores its commands and reaches them at once."""

    def __init__(self) -> None:
        super().__init__(Going.contract)
        self.commanded: list[np.ndarray] = []

    def observe(self) -> Obs:
        return Obs(
            state={
                "joints": (self.commanded[-1] if self.commanded else np.zeros(2)).astype(np.float32)
            }
        )

    def apply(self, action: np.ndarray) -> None:
        self.commanded.append(action)


def rows(root: Path, episode: int = 0) -> dict[str, Any]:
    return pq.read_table(root / f"data/chunk-000/file-{episode:03d}.parquet").to_pydict()


def back(obs: Obs) -> np.ndarray:
    return np.asarray(obs.state["joints"] - np.float32(0.04), np.float32)


@pytest.mark.parametrize(
    "options", [{"mode": "open_loop"}, {"mode": "ensemble"}, {"mode": "async", "deadline_s": 30.0}]
)
def test_a_correction_of_a_second_is_recorded_from_its_first_tick_with_both_actions(
    tmp_path: Path, clock: SimulatedTime, options: dict[str, Any]
) -> None:
    arm, guarded = Arm(), []

    class Seen(Guard):
        def __call__(self, action: np.ndarray, last: np.ndarray | None = None) -> np.ndarray:
            guarded.append(action.tolist())
            return super().__call__(action, last)

    leader = ScriptedLeader(back, lambda: 1.0 <= clock.now < 2.0)
    guard = Seen(Going.contract, max_step=MAX_STEP, measure=lambda obs: obs.state["joints"])
    recorder = Recorder(tmp_path, HZ, frames=1000, interventions=True)

    def answered() -> bool:
        """Wait until the policy has answered, since no simulated time passes between ticks."""
        wait_for(lambda: player._caller is None or not player._caller.busy, every_s=0.001)
        return False

    with (
        recorder,
        ChunkPlayer(Going(), PlayerSettings(**options), override=leader, check=guard) as player,
    ):
        report = run_loop(
            arm, player, hz=HZ, seconds=3.0, instruction="go", recorder=recorder, until=answered
        )
    seen = rows(tmp_path)
    led = [tick for tick, human in zip(seen["tick"], seen["intervention"], strict=True) if human]
    assert 49 <= len(led) <= 51
    assert report.interventions == len(led) == len(leader.given)
    assert led == list(range(led[0], led[0] + len(led)))
    assert abs(led[0] - round(1.0 * HZ)) <= 1, "at the first tick after the human engages"
    first = seen["tick"].index(led[0])
    human = np.array(seen["action"])[first : first + len(led)]
    policy = np.array(seen["policy_action"])[first : first + len(led)]
    assert human == pytest.approx(np.array(leader.given))
    assert all(seen["policy_known"][first : first + len(led)])
    assert (policy > human).all(), "the policy moves in the opposite direction"
    others = [
        i for i in range(len(seen["tick"])) if not seen["intervention"][i] and not seen["safe"][i]
    ]
    assert [seen["policy_action"][i] for i in others] == [seen["action"][i] for i in others]
    steps = np.abs(np.diff(np.stack([np.zeros(2), *arm.commanded]), axis=0))
    assert steps.max() <= MAX_STEP + 1e-6, "also at the release"
    assert all(action.tolist() in guarded for action in arm.commanded)


def test_pauses_are_counted_apart_from_ticks_that_the_policy_missed(clock: SimulatedTime) -> None:
    arm, leader = Arm(), ScriptedLeader(back)
    with ChunkPlayer(Going(), override=leader) as player:

        def over() -> bool:
            if leader.polls == 5:
                player.control.pause()
            return leader.polls == 40

        report = run_loop(arm, player, hz=HZ, until=over)
    assert (report.paused, report.safe, report.waiting, report.mostly_safe) == (35, {}, 0, None)
    assert len(arm.commanded) == 5, "a paused robot must get no command"


@pytest.mark.slow
def test_a_silent_server_stops_no_robot_that_a_human_moves() -> None:
    """A silent policy yields only safe actions. A human's actions count as signs of life."""
    gate = threading.Event()

    class Hanging(Going):
        asked = 0

        def act(self, obs: Obs) -> Act:
            self.asked += 1
            assert self.asked == 1 or gate.wait(30)
            return super().act(obs)

    arm, leader = Arm(), ScriptedLeader(back)
    leader.held = True
    watchdog = Watchdog(lambda _: arm.stop(), {"server": 1.0})
    with ChunkPlayer(Hanging(), PlayerSettings(mode="async"), override=leader) as player:

        def over() -> bool:
            if len(arm.commanded) == 75 and leader.held:
                assert watchdog.barks == []
                leader.held = False  # from here on, only the silent policy controls the robot
            return bool(watchdog.barks)

        report = run_loop(arm, player, hz=HZ, until=over, watchdog=watchdog)
        gate.set()
    assert report.interventions == 75
    assert report.barks[0].startswith("server: silent")


def add(recorder: Recorder, label: Any = None) -> None:
    with recorder.episode("stack"):
        recorder.add(Obs(state={"joints": np.zeros(2, np.float32)}), np.ones(2, np.float32), tick=0)
        recorder.add(
            Obs(state={"joints": np.zeros(2, np.float32)}),
            np.ones(2, np.float32),
            tick=1,
            intervention=True,
        )
        if label is not None:
            recorder.label(label)


def test_episodes_have_a_label_and_discarded_ones_are_dropped(tmp_path: Path) -> None:
    with Recorder(tmp_path, HZ, interventions=True) as recorder:
        for label in ("success", "discard", "failure", None):
            add(recorder, label)
        with pytest.raises(ConfigError, match="expected one of"):
            recorder.label("good")  # type: ignore[arg-type]
    about = [
        pq.read_table(path).to_pylist()[0]
        for path in sorted(tmp_path.glob("meta/episodes/*/*.parquet"))
    ]
    assert [one["label"] for one in about] == ["success", "failure", "none"]
    outcomes = [
        [rows(tmp_path, episode)[f"next.{name}"] for name in ("reward", "success")]
        for episode in range(3)
    ]
    assert outcomes == [[[0, 1], [False, True]], *[[[0, 0], [False, False]]] * 2]
    assert all(rows(tmp_path, episode)["next.done"] == [False, True] for episode in range(3))
    assert json.loads((tmp_path / "meta/info.json").read_text())["total_episodes"] == 3


def test_a_dataset_goes_on_with_its_own_columns(tmp_path: Path) -> None:
    with Recorder(tmp_path / "new", HZ, interventions=True) as recorder:
        add(recorder)
    seen = rows(tmp_path / "new")
    assert (seen["policy_action"], seen["policy_known"]) == ([[1, 1], [0, 0]], [True, False])
    with Recorder(tmp_path / "new", HZ) as recorder:
        add(recorder, "success")
    assert rows(tmp_path / "new", 1)["intervention"] == [False, True]
    with Recorder(tmp_path / "old", HZ) as recorder:
        add(recorder, "discard")
        add(recorder)
        with pytest.raises(ConfigError, match="interventions=True"):
            recorder.label("success")
    with pytest.raises(ConfigError, match="expected a recording with interventions"):
        Recorder(tmp_path / "old", HZ, interventions=True)
    with Recorder(tmp_path / "old", HZ) as recorder:
        add(recorder)
    assert json.loads((tmp_path / "old/meta/info.json").read_text())["total_episodes"] == 2
    assert "intervention" not in rows(tmp_path / "old", 1)


def test_a_recorder_without_a_place_for_interventions_is_refused_before_anything_moves(
    tmp_path: Path,
) -> None:
    arm = Arm()
    player = ChunkPlayer(Going(), override=ScriptedLeader(back))
    with (
        Recorder(tmp_path, HZ) as recorder,
        player,
        pytest.raises(ConfigError, match="interventions=True"),
    ):
        run_loop(arm, player, hz=HZ, seconds=1.0, recorder=recorder)
    assert arm.commanded == []


@pytest.mark.parametrize("mode", ["open_loop", "async"])
@pytest.mark.parametrize("relative", [False, True])
def test_a_recorded_frame_is_the_policys_or_an_operators_or_a_safe_one(
    tmp_path: Path, mode: Any, *, relative: bool
) -> None:
    """The operator's action is within the limits, beyond them, or missing, one after the other."""

    class Still(Agent):
        contract = Contract(action=ActionSpec(dim=2, delta=relative))

        def act(self, obs: Obs) -> Act:
            return Act(np.zeros((8, 2), np.float32))

    arm, ticks = Arm(), itertools.count()

    def led(obs: Obs) -> np.ndarray:
        tick = next(ticks)
        if tick % 3 == 2:
            raise RuntimeError("the device is unplugged")
        return np.full(2, 0.1 if tick % 3 == 0 else 3.0, np.float32)

    leader = ScriptedLeader(led, lambda: 5 <= leader.polls < 35)
    guard = Guard(Still.contract, low=-1.0, high=1.0)
    player = ChunkPlayer(
        Still(), PlayerSettings(mode, deadline_s=0.5), override=leader, check=guard
    )
    with player, Recorder(tmp_path, 200, interventions=True) as recorder:
        report = run_loop(arm, player, hz=200.0, recorder=recorder, until=lambda: leader.polls > 45)
    seen = rows(tmp_path)
    pairs = list(zip(seen["intervention"], seen["safe"], seen["action"], strict=True))
    operators = [action for intervention, _, action in pairs if intervention]
    assert not any(intervention and safe for intervention, safe, _ in pairs)
    assert operators == [pytest.approx([0.1, 0.1])] * 10
    assert report.interventions == 10
    assert sum(safe for _, safe, _ in pairs) >= 20
