"""Limits of speed, acceleration and jerk, their sources, and the slow motions from and to the rest
pose.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vlagents_ray import (
    Act,
    ActionSpec,
    Agent,
    ChunkPlayer,
    ConfigError,
    Contract,
    Obs,
    PlayerSettings,
)
from vlagents_ray.chunking.control import RobotControl
from vlagents_ray.errors import InvalidAction
from vlagents_ray.robot import Guard, LoopOptions, MotionLimits, run_loop

HZ = 50.0
LIMITS = MotionLimits(velocity=1.0, acceleration=10.0, jerk=500.0)

URDF = """<robot name="arm">
  <joint name="pan" type="revolute">
    <parent link="base"/><child link="a"/><origin xyz="0 0 0.1" rpy="0 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-1.5" upper="1.5" velocity="2" effort="1"/>
  </joint>
  <joint name="lift" type="revolute">
    <parent link="a"/><child link="b"/><origin xyz="0.2 0 0" rpy="1.5707963267948966 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" velocity="3" effort="1"/>
  </joint>
  <joint name="hand" type="fixed"><parent link="b"/><child link="tip"/><origin xyz="0.3 0 0"/></joint>
</robot>"""


def row(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def guard(limits: MotionLimits = LIMITS, **options: float) -> Guard:
    return Guard(limits=limits, hz=HZ, **{"soft_start_s": 0.0, **options})


def run(checked: Guard, *positions: float) -> None:
    last = None
    for position in positions:
        last = checked(row(position), last)


def test_speeding_up_is_limited_and_braking_is_not() -> None:
    limits = MotionLimits(velocity=1.0, acceleration=10.0)
    # braking, and starting in the other direction from rest.
    run(guard(limits), 0, 0.0039, 0.0078, 0.0078, 0.0039)
    for positions, said, cause in (
        ((0, 0.0041), "expected acceleration of at most 10 .*, got 10.25", "dynamics"),
        # An immediate reversal.
        ((0, 0.0030, 0.0060, 0.0030), "acceleration of at most 10 .*, got -15", "dynamics"),
        ((0, 0.021), "expected velocity of at most 1 .*, got 1.05", "max_step"),
    ):
        with pytest.raises(InvalidAction, match=said) as refused:
            run(guard(limits), *positions)
        assert refused.value.cause == cause


def test_a_jerk_is_refused_by_its_number() -> None:
    with pytest.raises(InvalidAction, match=r"expected jerk of at most 200 .*, got 250") as refused:
        run(guard(MotionLimits(velocity=1.0, jerk=200.0)), 0, 0.002)
    assert refused.value.cause == "dynamics"


def test_holding_always_passes() -> None:
    run(
        guard(MotionLimits(velocity=1.0, acceleration=1.0, jerk=1e4)),
        0,
        0.0003,
        0.0009,
        0.0009,
        0.0009,
    )


def test_the_limits_of_relative_actions_are_of_the_actions_themselves() -> None:
    checked = Guard(
        Contract(action=ActionSpec(dim=1, delta=True)), limits=LIMITS, hz=HZ, soft_start_s=0
    )
    checked(row(0.003), row(0))
    with pytest.raises(InvalidAction, match=r"velocity of at most 1 .*, got 1\.5"):
        checked(row(0.03), row(0.003))


def test_the_first_minutes_of_motion_have_half_of_the_limits() -> None:
    slow, fast = 0.009, 0.015  # 0.45 and 0.75 units/s
    checked = guard(MotionLimits(velocity=1.0), soft_start_s=1.0)
    with pytest.raises(InvalidAction, match="lowered by the soft start"):
        run(checked, 0, fast)
    last = checked(row(0))
    for i in range(1, 51):
        last = checked(row(slow * i), last)
    checked(last + row(fast), last)


def test_limits_need_the_rate_and_as_many_numbers_as_an_action_has() -> None:
    with pytest.raises(ConfigError, match="hz=None"):
        Guard(limits=LIMITS)
    with pytest.raises(ConfigError, match="expected one number, or 3"):
        Guard(Contract(action=ActionSpec(dim=3)), limits=MotionLimits(velocity=(1.0, 1.0)), hz=HZ)
    with pytest.raises(
        ConfigError,
        match=r"expected limits for 20.* Hz, the rate of the loop, got limits for 50.0 Hz",
    ):
        run_loop(Arm(), Line(), hz=20, seconds=0.1, options=LoopOptions(guard=guard()))


class Arm:
    """An arm that executes its commands exactly."""

    simulated = True

    def __init__(self, at: float = 0.0) -> None:
        self.path = [row(at, at)]
        self.stops = 0

    def observe(self) -> Obs:
        return Obs(state={"joints": self.path[-1].copy()})

    def apply(self, action: np.ndarray) -> None:
        self.path.append(action.copy())

    def stop(self) -> None:
        self.stops += 1


class Line(Agent):
    """A policy that moves at a constant speed from its first observed position, in chunks."""

    contract = Contract(action=ActionSpec(dim=2, delta=False))

    def __init__(self, begin: float = 0.0, step: float = 0.01, rows: int = 200) -> None:
        self.begin, self.speed, self.rows = begin, step, rows

    def act(self, obs: Obs) -> Act:
        column = self.begin + self.speed * np.arange(1, self.rows + 1)
        return Act(np.stack([column, column], 1).astype(np.float32), done=True)


def driven(arm: Arm, agent: Agent, limits: MotionLimits) -> np.ndarray:
    checked = Guard(
        agent.contract,
        limits=limits,
        hz=200,
        measure=lambda obs: obs.state["joints"],
        soft_start_s=0,
    )
    with ChunkPlayer(agent, PlayerSettings(deadline_s=5.0), check=checked) as player:
        report = run_loop(arm, player, hz=200, seconds=2)
    assert report.safe == {}
    return np.array(arm.path)[:, 0].astype(np.float64)


def test_the_first_action_is_eased_in_from_the_measured_pose_and_the_plan_follows_with_rising_speed() -> (
    None
):
    limits = MotionLimits(velocity=4.0, acceleration=80.0, jerk=16000.0)
    path = driven(Arm(), Line(begin=0.3), limits)
    steps, rows = np.diff(path), 0.3 + 0.01 * np.arange(1, 201)
    assert 0 < steps[0] < 1e-4
    assert steps.max() <= 0.01 + 1e-6  # the policy's own speed
    for order, limit in ((1, 4.0), (2, 80.0), (3, 16000.0)):
        assert np.abs(np.diff(path[: len(path) - 1], order)).max() * 200**order <= limit * 1.01
    assert np.isclose(path[-1], rows[-1])
    # Each row is executed, and none is skipped.
    assert np.isclose(path[-30:], rows[-30:], atol=1e-6).all()


def test_a_first_action_that_is_far_away_is_refused_with_the_distance() -> None:
    with pytest.raises(
        InvalidAction,
        match=r"expected a first action at most 0\.5 from the pose 0, got 0\.76, 0\.76 away",
    ):
        guard().ease_in(row(0), row(0.76))
    assert guard().ease_in(row(0), row(0.4)) is not None


def test_a_run_ends_with_a_slow_way_to_the_rest_pose() -> None:
    limits = MotionLimits(velocity=4.0, acceleration=80.0, jerk=16000.0, rest=(-0.2, 0.1))
    path = driven(arm := Arm(), Line(rows=20), limits)
    assert np.allclose(arm.path[-1], limits.rest)
    assert np.abs(np.diff(path)).max() <= 4.0 / 200
    assert arm.stops == 1


def test_a_stopped_robot_does_not_go_to_rest() -> None:
    class Stopping(Line):
        control = RobotControl()

        def act(self, obs: Obs) -> Act:
            if len(arm.path) == 5:
                self.control.stop("emergency")
            return Act(arm.path[-1] + row(0.001, 0.001))

    arm = Arm()
    limits = MotionLimits(velocity=4.0, rest=(-0.2, 0.1))
    run_loop(
        arm,
        Stopping(),
        hz=200,
        seconds=0.2,
        options=LoopOptions(guard=Guard(limits=limits, hz=200)),
    )
    assert len(arm.path) == 5
    assert np.allclose(arm.path[-1], 0.004)


@pytest.mark.parametrize("name", ["low", "high", "velocity", "acceleration", "jerk"])
def test_limits_of_different_arms_have_no_stricter_ones(name: str) -> None:
    bound = -1.0 if name == "low" else 1.0
    of_two, of_three = (MotionLimits(**{name: (bound,) * size}) for size in (2, 3))
    for ours, theirs in ((of_two, of_three), (of_three, of_two)):
        with pytest.raises(ConfigError, match=rf"{name}: expected as many numbers as in the other"):
            ours.stricter(theirs)
    of_all = MotionLimits(**{name: 2 * bound})
    assert getattr(of_two.stricter(of_all), name) == (bound, bound)


def test_a_file_of_limits_is_read_with_its_urdf(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "arm.yaml").write_text(
        "# of our arm\njoints: [pan, lift]\nvelocity: 2.5  # rad/s\nacceleration: [8, null]\n"
        "urdf: arm.urdf\ntip: tip\nworkspace_low: [-1, -1, 0.05]\n"
    )
    limits = MotionLimits.read(tmp_path / "arm.yaml")
    assert limits.joints == ("pan", "lift")
    assert limits.velocity == (2.0, 2.5)  # the stricter limit of the file and the URDF
    assert limits.acceleration == (8, math.inf)
    assert limits.low == (-1.5, -1.0)
    checked = guard(limits)
    checked(row(1.4, 0.1))
    with pytest.raises(
        InvalidAction, match=r"tip would be at z = -0\.152 m, below the workspace's 0\.05 m"
    ):
        checked(row(0, -1.0))
    with pytest.raises(InvalidAction, match=r"above the limit 1\.5"):
        checked(row(1.6, 0))


def test_the_tip_is_where_the_chain_of_transforms_puts_it(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "arm.json").write_text(
        json.dumps(
            {
                "joints": ["lift", "pan"],
                "urdf": "arm.urdf",
                "tip": "tip",
                "workspace_low": [-1, -1, -1],
            }
        )
    )
    chain = MotionLimits.read(tmp_path / "arm.json").chain
    assert chain is not None
    pan, lift = 0.7, -0.4
    reach = 0.2 + 0.3 * math.cos(lift)
    assert chain.tip([lift, pan]) == pytest.approx(
        (reach * math.cos(pan), reach * math.sin(pan), 0.1 + 0.3 * math.sin(lift))
    )


@pytest.mark.parametrize("unit", ["rad", "deg"])
@pytest.mark.parametrize("seed", range(10))
def test_the_tip_of_any_chain_is_where_its_transforms_put_it(
    tmp_path: Path, seed: int, unit: str
) -> None:
    """Joints of all kinds with axes in any direction, listed in order from the tip to the base."""
    random = np.random.default_rng(seed)
    kinds = random.permutation(["revolute", "continuous", "prismatic", "fixed", "revolute"])
    elements: list[str] = []
    numbers: dict[str, float] = {}
    expected_tip = np.zeros(3)
    for number, kind in enumerate(kinds):
        offset, rpy, axis = random.uniform(-3, 3, (3, 3))
        axis_element = f'<axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>'
        if number == seed % 5:  # the default of URDF
            axis, axis_element = np.array([1.0, 0.0, 0.0]), ""
        elements.append(
            f'<joint name="joint{number}" type="{kind}"><parent link="link{number + 1}"/>'
            f'<child link="link{number}"/>{axis_element}'
            f'<origin xyz="{offset[0]} {offset[1]} {offset[2]}" rpy="{rpy[0]} {rpy[1]} {rpy[2]}"/>'
            "</joint>"
        )

        axis /= np.linalg.norm(axis)
        motion = random.uniform(-2, 2)  # rad or m
        if kind == "prismatic":
            expected_tip = expected_tip + motion * axis
        elif kind != "fixed":
            expected_tip = Rotation.from_rotvec(motion * axis).apply(expected_tip)
        expected_tip = Rotation.from_euler("xyz", rpy).apply(expected_tip) + offset
        if kind != "fixed":
            is_angle = unit == "deg" and kind != "prismatic"
            numbers[f"joint{number}"] = math.degrees(motion) if is_angle else motion

    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{"".join(elements)}</robot>')
    document = {
        "joints": list(numbers),
        "unit": unit,
        "urdf": "arm.urdf",
        "tip": "link0",
        "workspace_low": [-1, -1, -1],
    }
    (tmp_path / "arm.json").write_text(json.dumps(document))
    chain = MotionLimits.read(tmp_path / "arm.json").chain
    assert chain is not None
    assert chain.tip(list(numbers.values())) == pytest.approx(tuple(expected_tip))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("velocty: 3", "velocty.*did you mean 'velocity'"),
        ("velocity: [1", "line 1"),
        ("- 1", "TypeError"),
        ("velocity: fast", "fast"),
        ("unit: grad", "unit: expected 'rad' or 'deg', got 'grad'"),
        ("urdf: none.urdf", "none.urdf"),
    ],
)
def test_a_file_with_a_mistake_is_refused(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "arm.yaml").write_text(text)
    with pytest.raises(ConfigError, match=said):
        MotionLimits.read(tmp_path / "arm.yaml")


def test_a_dataset_gives_the_limits_of_its_demonstrations(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    time_s = np.arange(300) / 30
    episodes = [
        np.stack([(1 - np.cos(time_s + phase)) ** 2 / 4, np.zeros(300)], 1).astype(np.float32)
        for phase in (0.0, 2.0)
    ]
    (tmp_path / "meta").mkdir()
    features = {"action": {"dtype": "float32", "shape": [2], "names": ["a.pos", "b.pos"]}}
    (tmp_path / "meta/info.json").write_text(json.dumps({"fps": 30, "features": features}))
    (tmp_path / "data/chunk-000").mkdir(parents=True)
    columns = {"action": np.concatenate(episodes).tolist(), "episode_index": np.repeat([0, 1], 300)}
    pq.write_table(pa.table(columns), tmp_path / "data/chunk-000/file-000.parquet")
    limits = MotionLimits.read(tmp_path)
    assert limits.joints == ("a.pos", "b.pos")
    # Twice the speed of the path, without a jump between the episodes.
    assert limits.velocity == pytest.approx((1.3, math.inf), rel=0.01)
    assert limits.acceleration == pytest.approx((2.0, math.inf), rel=0.01)
    assert limits.low == pytest.approx((-0.1, 0), abs=0.01)
    last = None
    checked = Guard(limits=limits, hz=30)
    for action in episodes[0]:  # the soft start also accepts the demonstrations
        last = checked(action, last)
