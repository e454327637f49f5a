"""For every arm, and every way to declare a gripper: the goal of a gripper changes only if the
policy or the operator changes it, and its unknown opening is not taken for open.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from arm_models import simulated_arm
from holding_arms import FOLLOWERS, ROS_TOPICS, FakeTwoArms, last_goal, robot_of, ros_robot

from vlagents_ray import Act, ActionSpec, Agent, ChunkPlayer, Contract, Obs, PlayerSettings
from vlagents_ray.contract import StateSpec
from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.robot import Guard, LoopOptions, MotionLimits, run_loop
from vlagents_ray.robot.guard import measured_state
from vlagents_ray.robot.simulated import SimulatedRobot
from vlagents_ray_robot.teleoperation import AxesDevice, AxesLeader

HZ = 400.0
TICKS = 60
JOINT_STEP = 1e-3  # the motion of a joint per tick


class Watched:
    """A robot that records the goals of its grippers after each command, and may hold.

    Args:
        robot: The robot.
        goals: Returns the goals of its grippers; [] while it has none.
    """

    simulated = False

    def __init__(self, robot: Any, goals: Callable[[], Sequence[float]]) -> None:
        self._robot, self._goals = robot, goals
        self.holds: str | None = None
        self.seen: list[tuple[float, ...]] = []
        self.applied = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._robot, name)

    def observe(self) -> Obs:
        return self._robot.observe()  # type: ignore[no-any-return]

    def apply(self, action: np.ndarray) -> None:
        self._robot.apply(action)
        self.applied += 1
        self._see()

    def stop(self) -> None:
        self._robot.stop()
        self._see()

    def _see(self) -> None:
        goals = tuple(float(goal) for goal in self._goals())
        if goals and (not self.seen or goals != self.seen[-1]):
            self.seen.append(goals)


@dataclass(frozen=True)
class ArmCase:
    """An arm whose gripper holds an object: it is measured at another opening than its goal."""

    # A context manager that yields a `Watched`, for the actions of a policy.
    make: Callable[[ActionSpec], Any]
    grippers: tuple[int, ...]
    dim: int
    parts: tuple[str, ...]  # the parts of the state with the measured pose; () for relative actions
    grasp: float  # the goal that the policy commands


@contextmanager
def lerobot(make: Callable[[], Any], buses: Callable[[Any], list[Any]]) -> Iterator[Watched]:
    follower = make()
    wires = buses(follower)

    def goals() -> list[float]:
        return [wire.goals["gripper"] for wire in wires if "gripper" in wire.goals]

    yield Watched(robot_of(follower), goals)


@contextmanager
def ros(topic: str) -> Iterator[Watched]:
    robot, wire = ros_robot(topic)
    with robot:
        yield Watched(robot, lambda: last_goal(wire)[2:] if wire.published else [])


@contextmanager
def mujoco(name: str, grippers: tuple[int, ...], delta: bool) -> Iterator[Watched]:
    with closing(simulated_arm(name, cameras=(), delta=delta)) as arm:
        observe = arm.observe

        def step() -> Obs:
            arm.clock.sleep(1 / HZ)
            return observe()

        def goals() -> list[float]:
            targets = arm._queue[-1][1] if arm._queue else arm._goal
            return [targets[i] for i in grippers]

        arm.observe = step  # type: ignore[method-assign]
        yield Watched(arm, goals)


class Own:
    """A user's class with two joints and a gripper, which declares its gripper in a given way. Its
    arm reaches each command at once; its fingers stay around an object.
    """

    def __init__(self, action: ActionSpec) -> None:
        self.contract = Contract(state={"joints": StateSpec(3)}, action=action)
        self.pose = np.array([0.1, 0.2, 0.5], np.float32)
        self.goal: np.ndarray | None = None
        self._columns = action.delta

    def observe(self) -> Obs:
        return Obs(state={"joints": self.pose.copy()})

    def apply(self, action: np.ndarray) -> None:
        self.goal = action.copy()
        if not self.contract.action.delta:
            self.pose[:2] = action[:2]

    def stop(self) -> None: ...


@contextmanager
def own(action: ActionSpec) -> Iterator[Watched]:
    robot = Own(action)
    yield Watched(robot, lambda: [] if robot.goal is None else [robot.goal[2]])


@contextmanager
def simulated(contract: Contract, grippers: tuple[int, ...]) -> Iterator[Watched]:
    robot = SimulatedRobot(contract)
    yield Watched(robot, lambda: robot._target[list(grippers)].tolist() if robot.applied else [])


BARE = ActionSpec(dim=3, space="joint", delta=False)
WAYS = {  # how an arm of the user, or a policy, declares the gripper
    "names": replace(BARE, names=("pan", "lift", "left_gripper")),
    "values": replace(BARE, gripper_open=1.0, gripper_closed=0.0),
    "columns": replace(BARE, grippers=(2,)),
}
ARMS: dict[str, ArmCase] = {}
for _name, _make in FOLLOWERS.items():
    ARMS[f"lerobot, {_name}"] = ArmCase(
        lambda _, make=_make: lerobot(make, lambda follower: [follower.wire]),  # type: ignore[misc]
        (2,),
        3,
        ("joints",),
        2.0,
    )
ARMS["lerobot, two arms"] = ArmCase(
    lambda _: lerobot(FakeTwoArms, lambda arms: [arms.left_arm.wire, arms.right_arm.wire]),
    (2, 5),
    6,
    ("joints",),
    2.0,
)
for _topic in ROS_TOPICS:
    ARMS[f"ros, {_topic}"] = ArmCase(
        lambda _, topic=_topic: ros(topic),  # type: ignore[misc]
        (2,),
        3,
        () if "deltas" in _topic else ("joints",),
        2.0,
    )
for (_way, _spec), _delta in itertools.product(WAYS.items(), (False, True)):
    _spec = replace(_spec, delta=_delta)
    ARMS[f"own class by {_way}, delta={_delta}"] = ArmCase(
        lambda _, spec=_spec: own(spec),  # type: ignore[misc]
        (2,),
        3,
        () if _delta else ("joints",),
        0.0,
    )


for _columns in ((2,), (2, 5)):
    # The simulated arm has the columns of the policy.
    ARMS[f"simulated, grippers {_columns}"] = ArmCase(
        lambda spec, columns=_columns: simulated(Contract(action=spec), columns),  # type: ignore[misc]
        _columns,
        _columns[-1] + 1,
        ("joints",),
        0.75,
    )
for _name, _columns, _parts in (
    ("so101", (5,), ("joints",)),
    ("aloha", (6, 13), ("left/joints", "right/joints")),
):
    for _delta in (False, True):
        ARMS[f"mujoco, {_name}, delta={_delta}"] = ArmCase(
            lambda _, name=_name, columns=_columns, delta=_delta: mujoco(name, columns, delta),  # type: ignore[misc]
            _columns,
            _columns[-1] + 1,
            () if _delta else _parts,
            0.25,
        )


def policy_spec(case: ArmCase, way: str, *, relative: bool) -> ActionSpec:
    """Return the actions of a policy that declares the grippers in a way, or not at all."""
    spec = ActionSpec(dim=case.dim, space="joint", delta=relative)
    arms = ("left", "right") if len(case.grippers) > 1 else None
    if way == "names":
        names = ["gripper" if i in case.grippers else f"joint{i}" for i in range(case.dim)]
        return replace(spec, names=tuple(f"{name}_{i}" for i, name in enumerate(names)))
    if way == "columns":
        return replace(spec, grippers=case.grippers)
    if way == "values":
        return replace(spec, gripper_open=1.0, gripper_closed=0.0, arms=arms)
    return spec


class Grasping(Agent):
    """A policy that moves the joints slowly, and keeps its grippers closed. Its server does not
    answer now and then.
    """

    contract: Contract | None = None

    def __init__(self, spec: ActionSpec, case: ArmCase, seed: int) -> None:
        self.contract = Contract(action=spec)
        self._case = case
        self._random = np.random.default_rng(seed)
        self._calls = 0

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        self._calls = 0  # the first answer always arrives
        return {}

    def act(self, obs: Obs) -> Act:
        self._calls += 1
        if self._calls > 1 and self._random.random() < 0.2:
            raise PolicyUnavailable("the server restarts")
        rows = np.full((20, self._case.dim), JOINT_STEP, np.float32)
        if self._case.parts:
            rows = np.cumsum(rows, axis=0) + pose_of(self._case, obs)
        rows[:, self._case.grippers] = self._case.grasp
        return Act(rows.astype(np.float32))


def pose_of(case: ArmCase, obs: Obs) -> np.ndarray:
    """Return the measured pose in the order of an action, (D,)."""
    measured = np.concatenate([obs.state[part] for part in case.parts])
    if len(measured) == case.dim:
        return measured
    pose = np.zeros(case.dim, np.float32)
    pose[[i for i in range(case.dim) if i not in case.grippers]] = measured
    return pose


class Device(AxesDevice):
    """A device with which the operator takes over, without a press of the gripper's button."""

    taken = False

    def engaged(self) -> bool:
        return self.taken

    def axes(self) -> np.ndarray:
        return np.zeros(6, np.float32)


def guard_of(case: ArmCase, contract: Contract, kind: str) -> Guard:
    measure = measured_state(*case.parts)
    if kind == "limits":
        limits = MotionLimits(velocity=20.0, acceleration=8000.0, jerk=4e6)
        return Guard(contract, measure=measure, limits=limits, hz=HZ, soft_start_s=0.0)
    if kind == "max_step":
        return Guard(contract, measure=measure, max_step=1.0)
    return Guard(contract)


EVENTS = ("pause", "stop", "holds", "takeover")


def drive(case: ArmCase, robot: Watched, way: str, kind: str, seed: int) -> int:
    """Run a loop in which each event occurs in a random order; return the number of commands."""
    random = np.random.default_rng(seed)
    spec = policy_spec(case, way, relative=not case.parts)
    policy = Grasping(spec, case, seed)
    device = Device()
    override = None
    if len(case.grippers) == 1:
        measure = measured_state(*case.parts)
        override = AxesLeader(policy.contract, device, step=JOINT_STEP, measure=measure)
    settings = PlayerSettings(
        "async" if seed % 2 else "open_loop", deadline_s=0.0 if seed % 2 else 1.0
    )
    guard = guard_of(case, policy.contract, kind)
    player = ChunkPlayer(policy, settings, check=guard, override=override)
    control = player.control

    events = [event for event in EVENTS if event != "takeover" or override is not None]
    random.shuffle(events)
    begin_at = {10 + 12 * number: event for number, event in enumerate(events)}
    end_at = {tick + int(random.integers(2, 8)): event for tick, event in begin_at.items()}
    ticks = itertools.count()

    def until() -> bool:
        tick = next(ticks)
        for at, begins in ((begin_at, True), (end_at, False)):
            event = at.get(tick)
            if event == "pause":
                control.pause() if begins else control.resume()
            elif event == "stop":
                control.stop("the button") if begins else control.restart()
            elif event == "holds":
                robot.holds = "a camera hangs" if begins else None
            elif event == "takeover":
                device.taken = begins
        return tick >= TICKS

    with player:
        run_loop(robot, player, hz=HZ, until=until, options=LoopOptions(restart="manual"))
    return robot.applied


def cases() -> Iterator[Any]:
    """Yield each arm, with each way in which a policy declares its grippers, and each guard."""
    for name, way, kind, seed in itertools.product(
        ARMS, ("undeclared", *WAYS), ("no limits", "max_step", "limits"), range(2)
    ):
        if name.startswith("simulated") and way == "undeclared":
            continue  # neither the policy nor the arm knows the gripper
        marks = []
        if name.startswith("mujoco"):
            marks = [pytest.mark.sim]
            if (way, kind, seed) not in (("undeclared", "limits", 0), ("values", "no limits", 1)):
                continue  # a model takes seconds to load
        yield pytest.param(name, way, kind, seed, marks=marks)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "way", "kind", "seed"), [*cases()])
def test_only_policy_and_operator_change_the_goal_of_a_gripper(
    name: str, way: str, kind: str, seed: int
) -> None:
    case = ARMS[name]
    with case.make(policy_spec(case, way, relative=not case.parts)) as robot:
        for run in range(2):  # the second run begins with a robot that holds something
            applied = drive(case, robot, way, kind, seed + 2 * run)
            assert applied > 0
    assert set(robot.seen) == {(case.grasp,) * len(case.grippers)}


class SingleActions(Agent):
    """A policy without a plan, which commands one closed gripper at each tick."""

    contract = Contract(action=BARE)

    def act(self, obs: Obs) -> Act:
        action = obs.state["joints"] + np.float32(JOINT_STEP)
        action[2] = 0.0
        return Act(action)


@pytest.mark.parametrize("way", WAYS)
def test_without_a_chunk_player_the_guard_also_knows_the_grippers_of_the_arm(way: str) -> None:
    measure = measured_state("joints")
    guard = Guard(SingleActions.contract, measure=measure, max_step=0.1)
    with own(WAYS[way]) as robot:
        ticks = itertools.count()

        def until() -> bool:
            tick = next(ticks)
            robot.holds = "a camera hangs" if 5 <= tick < 8 else None
            return tick > 20

        run_loop(robot, SingleActions(), hz=HZ, until=until, options=LoopOptions(guard=guard))
    assert robot.applied > 10
    assert set(robot.seen) == {(0.0,)}
