"""Motion limits for both kinds of actions and for one or two arms: no accepted sequence exceeds
them, from its first action.
"""

from __future__ import annotations

import itertools
import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

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
from vlagents_ray.columns import Columns
from vlagents_ray.contract import Rotation
from vlagents_ray.datasets.writer import Dataset
from vlagents_ray.errors import InvalidAction
from vlagents_ray.interface import SAFE
from vlagents_ray.robot import Guard, MotionLimits
from vlagents_ray.robot.record import Recorder

HZ = 50.0
SPEED, ACCELERATION, JERK = 1.0, 20.0, 800.0
LIMITS = MotionLimits(velocity=SPEED, acceleration=ACCELERATION, jerk=JERK)
KINDS = [
    pytest.param(delta, arms, id=f"{'relative' if delta else 'absolute'}, {arms or 1} arms")
    for delta, arms in itertools.product((False, True), (None, 2))
]
URDF = """<robot name="arm"><joint name="pan" type="revolute"><parent link="base"/><child link="hand"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="2"/></joint></robot>"""


def spec_of(delta: bool, arms: int | None) -> ActionSpec:
    """Return the specification of actions with two joints and a gripper for each arm."""
    names = None if arms is None else tuple(f"arm{i}" for i in range(arms))
    dim = 3 * (arms or 1)
    return ActionSpec(
        dim=dim, space="joint", delta=delta, gripper_open=1.0, gripper_closed=0.0, arms=names
    )


def path_of(spec: ActionSpec, actions: list[np.ndarray]) -> np.ndarray:
    """Return the commanded motion from rest, (T + 3, D). Relative actions are summed up."""
    rows = np.array(actions, np.float64)
    deltas = list(Columns.from_spec(spec, rows.shape[1]).relative)
    rows[:, deltas] = np.cumsum(rows[:, deltas], axis=0)
    rest = rows[0].copy()
    rest[deltas] = 0.0
    return np.concatenate([[rest] * 3, rows])


def require_within(path: np.ndarray, limits: MotionLimits, hz: float = HZ) -> None:
    """Fail if a path accelerates beyond the limits. Braking is always allowed."""
    speeds = np.diff(path, axis=0)
    for before, now, change_before in zip(
        speeds[1:-1], speeds[2:], np.diff(speeds, axis=0)[:-1], strict=True
    ):
        change = now - before
        brakes = (np.abs(now) <= np.abs(before)) & (now * before >= 0)
        assert (np.abs(now) * hz <= np.asarray(limits.velocity) * 1.001 + 1e-4).all()
        assert (
            brakes | (np.abs(change) * hz**2 <= np.asarray(limits.acceleration) * 1.001 + 1e-2)
        ).all()
        # A tick at rest ends the preceding deceleration.
        rested = ~before.any()
        jerk = np.abs(change if rested else change - change_before) * hz**3
        assert (brakes | (jerk <= np.asarray(limits.jerk) * 1.001 + 1.0)).all()


@pytest.mark.slow
@pytest.mark.parametrize(("delta", "arms"), KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_no_accepted_sequence_exceeds_the_limits_from_the_first_action_on(
    delta: bool, arms: int | None, seed: int
) -> None:
    spec = spec_of(delta, arms)
    guard = Guard(Contract(action=spec), limits=LIMITS, hz=HZ, soft_start_s=0)
    random = np.random.default_rng(seed)
    accepted: list[np.ndarray] = []
    deltas = list(Columns.from_spec(spec, spec.dim or 0).relative)
    last, motion = None, np.zeros(spec.dim or 0)
    for _ in range(2000):
        scale = 10 ** random.uniform(-4.5, 0.5)
        motion = motion * random.uniform(0.5, 1.2) + random.normal(0, scale, len(motion))
        position = np.zeros(len(motion)) if last is None else last.astype(np.float64)
        position[deltas] = 0.0
        action = (position + motion).astype(np.float32)
        try:
            last = guard(action, last)
        except InvalidAction:
            motion = np.zeros(len(motion))
        else:
            accepted.append(last)
    assert len(accepted) > 30
    require_within(path_of(spec, accepted), LIMITS)


@pytest.mark.parametrize(("delta", "arms"), KINDS)
@pytest.mark.parametrize("step", [0.5, 0.01, 0.002])
def test_no_command_of_a_player_exceeds_the_limits_from_the_first_one_and_after_a_stop(
    delta: bool, arms: int | None, step: float
) -> None:
    spec = spec_of(delta, arms)
    dim = spec.dim or 0

    class Straight(Agent):
        contract = Contract(action=spec, chunk=100)

        def act(self, obs: Obs) -> Act:
            rows = np.full((100, dim), step, np.float32)
            if not delta:
                rows = obs.state["joints"] + np.cumsum(rows, axis=0, dtype=np.float32)
            rows[:, list(Columns.from_spec(spec, dim).grippers)] = 0.5
            return Act(rows)

    pose = np.full(dim, 0.5, np.float32)
    measure = None if delta else (lambda obs: obs.state["joints"])
    guard = Guard(Contract(action=spec), limits=LIMITS, hz=HZ, soft_start_s=0, measure=measure)
    still = np.zeros(dim, np.float32)
    still[list(Columns.from_spec(spec, dim).grippers)] = 0.5
    settings = PlayerSettings(deadline_s=30.0, safe=still if delta else "hold")
    with ChunkPlayer(Straight(), settings, check=guard) as player:
        player.initialize()
        player.reset(Obs(state={"joints": pose}))
        commands = [still if delta else pose]
        runs, moved = [commands], 0
        for tick in range(200):
            if tick in (3, 80):  # the robot stands still
                player.interrupt()
                commands = [still if delta else pose]
                runs.append(commands)
            act = player.act(Obs(state={"joints": pose}))
            moved += SAFE not in act.info
            commands.append(act.action)
            if not delta:
                pose = act.action.copy()
    for commands in runs:
        require_within(path_of(spec, commands), LIMITS)
    if step * HZ <= SPEED:
        assert moved == 200, "a plan within the limits must be executed"
    else:
        assert player._plan.executed < 5, (
            "for a plan beyond the limits, only the slow motion to its first row is executed"
        )


@pytest.mark.slow
@pytest.mark.parametrize("delta", [False, True])
@pytest.mark.parametrize("limit", [0.05, 0.1, 0.3, 5.0])
@pytest.mark.parametrize("position", [0.0, 0.7, 3.1, 90.0, 179.0])
def test_a_step_of_exactly_the_limit_is_inside_in_float32(
    delta: bool, limit: float, position: float
) -> None:
    contract = Contract(action=ActionSpec(dim=1, delta=delta))
    guards = {
        "max_step": Guard(contract, max_step=limit),
        "velocity": Guard(
            contract, limits=MotionLimits(velocity=limit * HZ), hz=HZ, soft_start_s=0
        ),
        "acceleration": Guard(
            contract, limits=MotionLimits(acceleration=limit * HZ**2), hz=HZ, soft_start_s=0
        ),
        "jerk": Guard(contract, limits=MotionLimits(jerk=limit * HZ**3), hz=HZ, soft_start_s=0),
    }
    for offset in np.linspace(0, 1, 200):
        begin = np.array([0.0 if delta else position + offset], np.float32)
        at_the_limit = np.array([limit if delta else position + offset + limit], np.float32)
        beyond = np.array([1.01 * limit if delta else position + offset + 1.01 * limit], np.float32)
        for guard in guards.values():
            guard(at_the_limit, guard(begin))
            with pytest.raises(InvalidAction):
                guard(beyond, guard(begin))


@pytest.mark.parametrize("delta", [False, True])
@pytest.mark.parametrize("key", ["velocity", "acceleration", "jerk"])
@pytest.mark.parametrize("position", [0.0, 0.7])
def test_a_joint_with_the_limit_0_stays_where_it_is(delta: bool, key: str, position: float) -> None:
    contract = Contract(action=ActionSpec(dim=1, delta=delta))
    guard = Guard(contract, limits=MotionLimits(**{key: 0.0}), hz=HZ)
    still = np.array([0.0 if delta else position], np.float32)
    last = None
    for _ in range(3):
        last = guard(still, last)
    with pytest.raises(InvalidAction):
        guard(still + np.float32(0.01), last)


@pytest.mark.parametrize("bound", [0.1, 1.7, 3.14159265])
def test_a_bound_is_inside_in_float32(bound: float) -> None:
    guard = Guard(limits=MotionLimits(low=-bound, high=bound), hz=HZ)
    for sign in (-1, 1):
        guard(np.array([sign * bound], np.float32))


def test_the_distance_of_the_first_action_is_limited_by_first_alone_if_it_is_given() -> None:
    for first, velocity, accepted in (
        (None, 1.0, 0.5),
        (0.3, 1.0, 0.3),
        (1.0, 1.0, 1.0),
        (5.0, 1.0, 5.0),
        (1, None, 1),
    ):
        limits = MotionLimits(velocity=velocity, acceleration=10.0, jerk=500.0, first=first)
        guard = Guard(limits=limits, hz=HZ, soft_start_s=0)
        zero = np.zeros(2, np.float32)
        assert guard.ease_in(zero, np.array([0, accepted], np.float32)) is not None
        with pytest.raises(
            InvalidAction, match=f"expected a first action at most {accepted:.3g} from"
        ):
            guard.ease_in(zero, np.array([0, 1.01 * accepted], np.float32))


# Each key of a limits file has an effect, or is an error.

EFFECTS: dict[str, tuple[dict[str, object], list[list[float]]]] = {
    # The smallest file with this key, and a sequence of actions that it rejects.
    "low": ({"low": 0.0}, [[-0.1]]),
    "high": ({"high": [1.0]}, [[1.1]]),
    "velocity": ({"velocity": 1.0}, [[0], [0.03]]),
    "acceleration": ({"acceleration": 10.0}, [[0], [0.01]]),
    "jerk": ({"jerk": 100.0}, [[0], [0.01]]),
    "urdf": ({"urdf": "arm.urdf"}, [[1.1]]),
    "unit": ({"urdf": "arm.urdf", "unit": "deg"}, [[60.0]]),
    "joints": ({"urdf": "arm.urdf", "joints": ["pan"]}, [[1.1]]),
    "tip": ({"urdf": "arm.urdf", "tip": "hand", "workspace_low": [0.1, 0, 0]}, [[0]]),
    "workspace_low": (
        {"urdf": "arm.urdf", "tip": "hand", "workspace_low": [None, None, 0.1]},
        [[0]],
    ),
    "workspace_high": (
        {"urdf": "arm.urdf", "tip": "hand", "workspace_high": [None, -0.1, None]},
        [[0]],
    ),
}


def written(folder: Path, document: dict[str, object]) -> Path:
    (folder / "arm.urdf").write_text(URDF)
    (folder / "limits.json").write_text(json.dumps(document))
    return folder / "limits.json"


def test_the_table_of_effects_has_each_key_of_a_file() -> None:
    named = {field.name for field in fields(MotionLimits)} - {"chain"} | {"urdf", "tip"}
    # "first" and "rest" do not apply to a sequence of actions; each has its own tests.
    assert {*EFFECTS, "first", "rest"} == named


@pytest.mark.parametrize("key", EFFECTS)
def test_each_key_of_a_file_refuses_an_absolute_action(tmp_path: Path, key: str) -> None:
    document, actions = EFFECTS[key]
    guard = Guard(
        Contract(action=ActionSpec(dim=1, delta=False)), limits=written(tmp_path, document), hz=HZ
    )

    def run() -> None:
        last = None
        for action in actions:
            last = guard(np.array(action, np.float32), last)

    with pytest.raises(InvalidAction):
        run()


@pytest.mark.parametrize("key", [*EFFECTS, "first", "rest"])
def test_each_key_of_a_file_refuses_a_relative_action_or_is_an_error(
    tmp_path: Path, key: str
) -> None:
    document = {"first": {"first": 0.1}, "rest": {"rest": [0.1]}}.get(key) or EFFECTS[key][0]
    path = written(tmp_path, document)
    contract = Contract(action=ActionSpec(dim=1, delta=True))
    if key in ("velocity", "acceleration", "jerk"):
        guard = Guard(contract, limits=path, hz=HZ)
        with pytest.raises(InvalidAction):
            guard(np.array([0.03], np.float32))
    else:
        with pytest.raises(ConfigError, match="for relative actions"):
            Guard(contract, limits=path, hz=HZ)


def test_bounds_of_a_gripper_have_an_effect_for_relative_actions_as_well() -> None:
    contract = Contract(action=spec_of(delta=True, arms=2))
    limits = MotionLimits(low=(-np.inf, -np.inf, 0.0) * 2, high=(np.inf, np.inf, 1.0) * 2)
    guard = Guard(contract, limits=limits, hz=HZ)
    guard(np.array([0, 0, 1, 0, 0, 0.5], np.float32))
    with pytest.raises(InvalidAction, match=r"action\[2\]: expected .*, got 1.1, above"):
        guard(np.array([0, 0, 1.1, 0, 0, 0.5], np.float32))


@pytest.mark.parametrize(
    ("document", "said"),
    [
        *(
            ({key: float("nan")}, key)
            for key in ("low", "high", "velocity", "acceleration", "jerk", "first")
        ),
        *(({key: [1.0, float("nan")]}, key) for key in ("low", "high", "velocity", "rest")),
        ({"velocity": -1.0}, "velocity: expected numbers of 0 or more"),
        ({"velocity": True}, "velocity: expected numbers"),
        ({"rest": [float("inf")]}, "rest: expected finite"),
        ({"unit": "deg"}, "unit: expected `urdf`"),
        ({"joints": "pan"}, "joints: expected a list"),
        ({"urdf": "arm.urdf", "tip": "hand"}, "tip, urdf and workspace"),
        ({"workspace_low": [0, 0, 0]}, "tip, urdf and workspace"),
        (
            {"urdf": "arm.urdf", "tip": "hand", "workspace_low": [0, 0]},
            "workspace_low: expected x, y and z",
        ),
        (
            {"urdf": "arm.urdf", "tip": "hand", "workspace_low": [0, 0, float("nan")]},
            "workspace_low",
        ),
    ],
    ids=str,
)
def test_a_number_or_key_of_a_file_that_would_have_no_effect_is_an_error(
    tmp_path: Path, document: dict[str, object], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        MotionLimits.read(written(tmp_path, document))


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        (MotionLimits(rest=(0.0,)), "rest: expected 3 numbers"),
        (MotionLimits(low=1.0, high=0.0), "expected low below high"),
        (MotionLimits(first=(1.0, 2.0)), "expected one number, or 3"),
        (MotionLimits(rest=(0.0, 0.0, 0.0)), "rest: expected null for the grippers"),
    ],
    ids=str,
)
def test_limits_that_do_not_fit_the_actions_are_an_error_before_the_first_one(
    limits: MotionLimits, said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        Guard(Contract(action=spec_of(delta=False, arms=None)), limits=limits, hz=HZ)


# Limits derived from a dataset accept its demonstrations.


def recorded(root: Path, spec: ActionSpec | None, episodes: list[np.ndarray]) -> Path:
    """Write a dataset with these episodes, (T, D) each."""
    dataset = Dataset(root, HZ, durable=False)
    for actions in episodes:
        episode = dataset.begin("stack", spec)
        for tick, action in enumerate(actions):
            obs = Obs(state={"joints": np.zeros(1, np.float32)})
            episode.add(obs, action, tick / HZ, tick, False)
        dataset.save(episode.finish())
    return root


def demonstrations(spec: ActionSpec, seed: int) -> list[np.ndarray]:
    """Return smooth motions from rest with grippers that open and close, (T, D) each."""
    random = np.random.default_rng(seed)
    episodes = []
    for _ in range(3):
        time_s = np.arange(int(random.integers(300, 600))) / HZ
        periods_s = random.uniform(2, 6, spec.dim or 1)
        actions = np.sin(np.pi * time_s[:, None] / periods_s) ** 3 * random.uniform(
            0.2, 1.0, spec.dim or 1
        )
        deltas = list(Columns.from_spec(spec, spec.dim or 1).relative)
        moved = np.diff(actions, axis=0, prepend=0.0)
        actions[:, deltas] = moved[:, deltas]
        episodes.append(actions.astype(np.float32))
    return episodes


def missing_ticks(random: np.random.Generator, ticks: int) -> np.ndarray:
    """Return for each tick whether a recorder misses it: single frames that it drops, and pauses
    and takeovers of up to two seconds.
    """
    is_missing = random.random(ticks) < random.choice([0.002, 0.01, 0.1, 0.4])
    for begin in random.integers(0, ticks, random.integers(0, 4)):
        is_missing[begin : begin + random.integers(2, 2 * HZ)] = True
    is_missing[:3] = False  # an episode begins at rest
    return is_missing


@pytest.mark.parametrize(("delta", "arms"), KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_limits_of_a_recording_with_gaps_are_those_of_the_recording_without(
    tmp_path: Path, delta: bool, arms: int | None, seed: int
) -> None:
    spec = spec_of(delta, arms)
    episodes = demonstrations(spec, seed)
    complete = MotionLimits.read(recorded(tmp_path / "complete", spec, episodes))

    random = np.random.default_rng(seed)
    root = tmp_path / "with_gaps"
    with Recorder(root, HZ, frames=10_000) as recorder:
        for actions in episodes:
            is_missing = missing_ticks(random, len(actions))
            with recorder.episode("stack"):
                for tick in np.flatnonzero(~is_missing):
                    obs = Obs(state={"joints": np.zeros(1, np.float32)})
                    recorder.add(obs, actions[tick], tick=int(tick))

    with_gaps = MotionLimits.read(root, spec)
    for name in ("velocity", "acceleration", "jerk"):
        limits = np.asarray(getattr(with_gaps, name))
        # A gripper that did not move in the frames that were kept has no limit.
        limits[np.isinf(limits)] = 0.0
        assert (limits <= 1.5 * np.asarray(getattr(complete, name))).all(), name


def test_a_recording_of_single_frames_gives_no_limits(tmp_path: Path) -> None:
    with Recorder(tmp_path, HZ, frames=1000) as recorder, recorder.episode("stack"):
        for tick in range(0, 200, 2):
            obs = Obs(state={"joints": np.zeros(1, np.float32)})
            recorder.add(obs, np.full(2, tick / 200, np.float32), tick=tick)
    with pytest.raises(ConfigError, match="expected 2 frames at consecutive ticks, got at most 1"):
        MotionLimits.read(tmp_path)


def require_accepted(guard: Guard, actions: np.ndarray) -> None:
    """Fail unless a guard accepts all rows of an episode, (T, D)."""
    last = None
    for action in actions:
        last = guard(action, last)


@pytest.mark.slow
@pytest.mark.parametrize(("delta", "arms"), KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_limits_of_a_dataset_accept_its_demonstrations_and_no_ten_times_faster_ones(
    tmp_path: Path, delta: bool, arms: int | None, seed: int
) -> None:
    spec = spec_of(delta, arms)
    episodes = demonstrations(spec, seed)
    folder = recorded(tmp_path / "demos", spec, episodes)
    for soft_start_s in (0.0, 120.0):
        guard = Guard(Contract(action=spec), limits=folder, hz=HZ, soft_start_s=soft_start_s)
        for actions in episodes:
            require_accepted(guard, actions)
    faster = episodes[0][::10] * (10 if delta else 1)
    with pytest.raises(InvalidAction):
        require_accepted(guard, faster)


DOWN = {  # a hand that points down, where Euler angles and rotation vectors wrap
    "euler_xyz": (3.1, 0.0, 0.0),
    "axis_angle": (3.1, 0.0, 0.0),
    "quat_xyzw": (1.0, 0.0, 0.0, 0.02),
    "quat_wxyz": (0.02, 1.0, 0.0, 0.0),
    "rot6d": (1.0, 0.0, 0.0, 0.0, -1.0, 0.04),
}


@pytest.mark.parametrize("delta", [False, True])
@pytest.mark.parametrize("kind", DOWN)
def test_limits_of_a_dataset_of_poses_are_those_of_the_angle_of_its_rotations(
    tmp_path: Path, kind: Rotation, *, delta: bool
) -> None:
    spec = ActionSpec(dim=3 + len(DOWN[kind]), space="ee_pose", delta=delta, rotation=kind)
    columns = Columns.from_spec(spec, spec.dim or 0)
    speed = 0.5 / HZ  # rad per tick, about a diagonal axis
    time_s = np.arange(600) / HZ
    pose = np.array([0.0, 0.0, 0.0, *DOWN[kind]], np.float32)
    rows = []
    for part in np.sin(np.pi * time_s / 3) ** 2:
        turn = part * speed * np.array([1.0, 1.0, 1.0]) / np.sqrt(3)
        motion = np.zeros(columns.dim)
        motion[3:6] = turn
        pose = columns.moved(pose, motion.tolist())
        row = pose.copy()
        if kind == "euler_xyz" and not delta:
            row[3:] = (row[3:] + np.pi) % (2 * np.pi) - np.pi
        elif kind.startswith("quat") and not delta and len(rows) % 7 == 0:
            row[3:] = -row[3:]  # the same rotation
        rows.append(row)

    folder = recorded(tmp_path / "demos", spec, [np.array(rows)])
    limits = MotionLimits.read(folder)
    assert isinstance(limits.velocity, tuple)
    assert limits.velocity[3:6] == pytest.approx([2 * 0.5] * 3, rel=0.05)
    guard = Guard(Contract(action=spec), limits=folder, hz=HZ)
    require_accepted(guard, np.array(rows))


def test_a_dataset_without_a_contract_has_actions_of_the_policys_kind(tmp_path: Path) -> None:
    spec = ActionSpec(dim=2, delta=True)
    episodes = demonstrations(spec, 0)
    folder = recorded(tmp_path / "demos", spec, episodes)
    info = json.loads((folder / "meta/info.json").read_text())
    del info["vlagents_ray"]
    (folder / "meta/info.json").write_text(json.dumps(info))
    speeds = np.abs(np.concatenate(episodes)).max(0) * HZ
    assert np.asarray(MotionLimits.read(folder, spec).velocity) == pytest.approx(
        2 * speeds, rel=0.05
    )
    guard = Guard(Contract(action=spec), limits=folder, hz=HZ)
    guard(episodes[0][1], guard(episodes[0][0]))
    with pytest.raises(ConfigError, match=r"for relative actions, .*, got low, high"):
        Guard(Contract(action=spec), limits=MotionLimits.read(folder), hz=HZ)


@pytest.mark.parametrize("delta", [False, True])
def test_a_dataset_with_one_number_an_action_has_limits(tmp_path: Path, delta: bool) -> None:
    spec = ActionSpec(dim=1, delta=delta)
    episodes = demonstrations(spec, 0)
    guard = Guard(Contract(action=spec), limits=recorded(tmp_path / "demos", spec, episodes), hz=HZ)
    last = None
    for action in episodes[0]:
        last = guard(action, last)


def test_constant_deltas_from_the_first_frame_on_have_limits_that_accept_them(
    tmp_path: Path,
) -> None:
    spec = ActionSpec(dim=2, space="ee_position", delta=True)
    rows = np.tile(np.array([0.01, 0.005], np.float32), (600, 1))
    guard = Guard(Contract(action=spec), limits=recorded(tmp_path / "demos", spec, [rows]), hz=HZ)
    last = None
    for action in rows:
        last = guard(action, last)
    with pytest.raises(InvalidAction):
        guard(np.array([1.0, 0.0], np.float32), last)
