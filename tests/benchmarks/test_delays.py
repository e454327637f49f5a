"""The measure of success by delay: its rows, its curves, and the smoothness of a path."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import typer

from benchmarks import delays
from benchmarks.absolute import AbsoluteTabletop, FromFirstPose
from benchmarks.delays import Episode, curves, jerk, oscillation, row
from vlagents_ray.contract import ActionSpec
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.success import SuccessCurve, read_curves

HZ = 10.0


class Fixed(Agent):
    """Returns one answer."""

    def __init__(self, answer: Act) -> None:
        self.answer = answer

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        return [self.answer for _ in obs]


def episodes(*solved: bool, ticks: int = 20, digest: str = "a") -> list[Episode]:
    return [Episode(one, ticks, 5, f"{digest}{one}", 1.0, None) for one in solved]


def test_a_path_without_jerk_and_one_that_oscillates() -> None:
    seconds = np.arange(40)[:, None] / HZ
    parabola = np.concatenate([seconds**2, 2 * seconds, 0 * seconds], 1)
    assert jerk(parabola, HZ) == pytest.approx(0.0, abs=1e-8)
    # The third derivative of t³ along two axes is 6 each.
    cubic = np.concatenate([seconds**3, seconds**3, 0 * seconds], 1)
    assert jerk(cubic, HZ) == pytest.approx(6 * np.sqrt(2))
    assert jerk(cubic[:3], HZ) is None

    # A straight path is its own moving average.
    straight = np.concatenate([seconds, -seconds, 0 * seconds], 1)
    assert oscillation(straight, HZ) == pytest.approx(0.0, abs=1e-12)
    # Alternating by 1 cm, a window of an odd number of ticks keeps one of them.
    shaken = straight + 0.01 * np.array([0.0, 0.0, 1.0]) * (-1) ** np.arange(40)[:, None]
    window = 2 * round(0.5 * HZ / 2) + 1
    assert oscillation(shaken, HZ) == pytest.approx(0.01 * (1 - 1 / window), rel=1e-6)
    assert oscillation(straight[: window - 1], HZ) is None


@pytest.mark.parametrize(
    ("delta", "actions", "standing"),
    [
        (
            True,
            [[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.0, -1.0]],
            2,
        ),  # the gripper does not count
        (False, [[0.2, 0.1, 1.0], [0.2, 0.1, -1.0], [0.2, 0.2, -1.0], [0.2, 0.2, -1.0]], 2),
    ],
)
def test_a_robot_that_only_moves_its_gripper_stands(
    delta: bool, actions: list[list[float]], standing: int
) -> None:
    spec = ActionSpec(dim=3, delta=delta, gripper_open=1.0, gripper_closed=-1.0)
    motions = delays.Motions(spec, None)
    for action in actions:
        motions.add_action(np.array(action, np.float32), 0.0, False)
    assert motions.standing == standing


def test_a_row_compares_the_same_seeds() -> None:
    synchronous = episodes(True, True, True, False)
    late = episodes(True, False, True, True, ticks=40, digest="b")
    found = row("async", "3", late, synchronous, HZ)
    assert (found["solved"], found["only_a"], found["only_b"], found["both"]) == (3, 1, 1, 2)
    assert (found["difference"], found["equal"], found["ticks"]) == (0.0, 0, 40.0)
    assert found["standing"] == 5 / 40
    assert found["tasks_per_hour"] == pytest.approx(3 / (4 * 40) * HZ * 3600)
    assert (found["jerk"], found["oscillation"]) == (1.0, None)
    assert row("async", "0", synchronous, synchronous, HZ)["equal"] == 4


def test_a_curve_of_each_mode_with_the_settings_of_a_chunk_player() -> None:
    synchronous = episodes(True, True, False)
    rows = [
        row(delays.SYNCHRONOUS, "0", synchronous, synchronous, HZ),
        row("async", "0", synchronous, synchronous, HZ),
        row("async", "3", episodes(True, False, False), synchronous, HZ),
        row("async", "1 to 4", synchronous, synchronous, HZ),
        row("prefixes", "0", synchronous, synchronous, HZ),
        row("stop and wait", "3", synchronous, synchronous, HZ),
    ]
    found = curves(rows, "tabletop", HZ, 4, "digest")
    named: dict[str, SuccessCurve] = {str(dict(one.settings)): one for one in found}
    assert named.keys() == {
        "{'execute': 4}",
        "{'execute': 4, 'real_time_chunking': True}",
    }
    curve = named["{'execute': 4}"]
    assert (curve.mode, curve.weights, list(curve.solved)) == ("async", "digest", [0, 3])
    assert (curve.solved[3].solved, curve.solved[3].episodes) == (1, 3)


def test_the_clocks_have_the_delays_in_rows_of_the_rate() -> None:
    assert delays.clock_of(delays.MODES["async"], 3, 20.0).latency == 0.15
    varying = delays.clock_of(delays.MODES["async"], delays.VARYING, 10.0).latency
    assert isinstance(varying, list)
    assert set(varying) == {0.1, 0.2, 0.3, 0.4}
    lost = [rows for rows in delays.LOST if rows > 1]
    assert 0.02 < len(lost) / len(delays.LOST) < 0.1


@pytest.mark.torch
def test_it_measures_the_reference_policy_and_writes_its_curves(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    checkpoint = tmp_path / "checkpoint"
    checkpoint.mkdir()
    file = tmp_path / "rows.json"

    def measure() -> list[dict[str, object]]:
        delays.main(
            "deployments/reference.yaml",
            "tabletop",
            env_set=[],
            clock_set=[],
            settings=[],
            execute=4,
            episodes=2,
            batch=2,
            modes="async; stop and wait",
            delays="0; 1 to 4",
            position="xyzrpy",
            folder=tmp_path / "runs",
            checkpoint=checkpoint,
            out_file=file,
        )
        return json.loads(file.read_text())["rows"]  # type: ignore[no-any-return]

    rows = measure()
    assert [(one["mode"], one["delay"]) for one in rows] == [
        ("synchronous", "0"),
        ("async", "0"),
        ("async", "1 to 4"),
        ("stop and wait", "0"),
        ("stop and wait", "1 to 4"),
    ]
    assert rows[1]["equal"] == rows[3]["equal"] == 2, "no delay changes nothing, to the bit"
    assert rows[4]["standing"] > rows[2]["standing"]  # type: ignore[operator]
    found = read_curves(checkpoint)
    assert [curve.mode for curve in found] == ["async", "open_loop"]
    assert {curve.weights for curve in found} != {None}
    assert measure() == rows, "nothing was run again"
    assert read_curves(checkpoint) == found


def test_unknown_names_are_rejected_with_the_known_ones() -> None:
    with pytest.raises(typer.Exit):
        delays.main(modes="asynchronous", settings=[], env_set=[], clock_set=[])


def test_absolute_actions_lead_to_the_same_poses_as_relative_ones() -> None:
    options = {"width": 64, "height": 64, "max_steps": 30}
    relative, absolute = Tabletop(**options), AbsoluteTabletop(**options)
    assert absolute.contract.action.delta is False
    obs, _ = relative.reset(seed=3)
    absolute.reset(seed=3)
    rows = np.random.default_rng(0).uniform(-1.5, 1.5, (10, 4)).astype(np.float32)
    rows[:, 1] = -np.abs(rows[:, 1]) / 4  # away from the limits of the reach
    rows[:, 2] /= 8
    rows[:, 0] /= 2
    [act] = FromFirstPose(Fixed(Act(rows))).act_batch([obs], [FromFirstPose(Fixed(Act(rows)))])
    assert isinstance(act, Act)
    targets = act.action + np.append(obs.state["xyzrpy"][:3], 0.0)
    for row_of_chunk, target in zip(rows, targets, strict=True):
        there, *_ = relative.step(Act(row_of_chunk))
        here, *_ = absolute.step(Act(target.astype(np.float32)))
        np.testing.assert_allclose(here.state["xyz"], there.state["xyzrpy"][:3], atol=1e-6)
        assert here.gripper == pytest.approx(there.gripper)
