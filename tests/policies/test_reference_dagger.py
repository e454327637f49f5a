"""DAgger with the reference policy: an expert's corrections, and training on these alone."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlagents_ray.envs import make_env
from vlagents_ray.interface import DELAY, GIVEN, LEFTOVER
from vlagents_ray.policies.reference import Reference
from vlagents_ray.recorded_dataset import Names, RecordedDataset

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

REFERENCE = Path(__file__).parents[2] / "examples" / "reference"
CAMERAS = {"tabletop": {"scene": "front", "wrist": "wrist"}}


def program(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(
        f"reference_{name}_of_dagger", REFERENCE / f"{name}.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    program("dagger").record(
        REFERENCE / "pretrained", folder / "tabletop", episodes=6, seed=2_000_000
    )
    return folder


def test_the_expert_takes_over_once_and_solves_each_recorded_episode(data: Path) -> None:
    dataset = RecordedDataset(data / "tabletop")
    assert dataset.sessions()
    begun = []
    for session in dataset.sessions():
        steps = list(dataset.steps(session.episodes[0], Names(), None))
        led = [step.intervention for step in steps]
        assert led == sorted(led)
        assert led[-1]
        begun.append(led.index(True))
        assert (steps[begun[-1]].obs.gripper or 0) > 0.9
    assert len(set(begun)) > 1, "the corrections must begin at different ticks"


def test_training_goes_on_from_the_checkpoint_with_the_experts_frames_alone(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train, start = program("train"), REFERENCE / "pretrained"
    monkeypatch.setattr(train, "BATCH", 16)
    before = train.read_checkpoint(start)
    checkpoint, frames = train.read(data, CAMERAS, tmp_path / "images", start=before)
    assert checkpoint == before
    dataset = RecordedDataset(data / "tabletop")
    led = []
    for session in dataset.sessions():
        led += [step.intervention for step in dataset.steps(session.episodes[0], Names(), None)]
    assert np.array_equal(frames.place, np.flatnonzero(led))
    old = train.read_network(before.sizes, start).state_dict()
    new = train.fit(
        checkpoint, frames, 2, 0, tmp_path / "state.pt", rate=1e-4, start=start
    ).state_dict()
    moved = max(float((new[name] - value).abs().max()) for name, value in old.items())
    assert 0 < moved < 1e-3


LONGEST = 3  # rows


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return corrections of a policy whose answers are late."""
    folder = tmp_path_factory.mktemp("late")
    program("dagger").record(
        REFERENCE / "pretrained", folder / "tabletop", episodes=6, seed=2_000_000, delay=LONGEST
    )
    return folder


def test_under_delay_the_expert_continues_rows_that_the_policy_had_planned(
    late: Path, tmp_path: Path
) -> None:
    train, start = program("train"), REFERENCE / "pretrained"
    _, frames = train.read(
        late, CAMERAS, tmp_path / "images", start=train.read_checkpoint(start), delays=LONGEST
    )
    dataset, first = RecordedDataset(late / "tabletop"), 0
    led: list[bool] = []
    for session in dataset.sessions():
        led += [step.intervention for step in dataset.steps(session.episodes[0], Names(), None)]
    lengths = frames.given[frames.place].tolist()
    assert set(lengths) == {-1, *range(1, LONGEST + 1)}
    for place, length in zip(frames.place.tolist(), lengths, strict=True):
        first, end = place + max(length, 0), int(frames.end[place])
        assert not any(led[place:first])
        assert first < end
        assert all(led[first:end])


def test_a_training_for_delays_gives_a_policy_whose_chunks_begin_with_given_rows(
    late: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train, start = program("train"), REFERENCE / "pretrained"
    monkeypatch.setattr(train, "BATCH", 32)
    monkeypatch.setattr(torch, "use_deterministic_algorithms", lambda _: None)
    out = tmp_path / "checkpoint"
    options = {"cameras": ["tabletop=front,wrist"], "steps": 3, "threads": 1, "start": start}
    train.main(late, out, rate=1e-3, delays=LONGEST, work=tmp_path / "work", **options)

    assert list(train.read_checkpoint(out).embodiments) == ["tabletop"]
    old = train.read_network(train.read_checkpoint(start).sizes, start).state_dict()
    new = train.read_network(train.read_checkpoint(out).sizes, out).state_dict()
    changed = {name.partition(".")[0] for name in old if not torch.equal(old[name], new[name])}
    assert changed == set(train.HEAD) - {"given"}
    assert new["given.2.weight"].any()

    policy = Reference.from_config({"checkpoint": str(out)})
    policy.initialize()
    obs = policy_view()
    policy.reset(obs, "lift the blue puck", seed=0)
    plan = np.full((4, 4), 0.5, np.float32)
    act = policy.act(replace(obs, info={LEFTOVER: plan, DELAY: 9}))
    assert policy.longest_prefix == act.info[GIVEN] == LONGEST
    np.testing.assert_array_equal(act.action[:LONGEST], plan[:LONGEST])
    with pytest.raises(train.typer.BadParameter, match="expected --start"):
        train.main(late, out, delays=LONGEST, **{**options, "start": None})


def policy_view() -> Any:
    with make_env("tabletop", cameras=["front", "wrist"], width=64, height=64) as env:
        return env.reset(seed=0)[0]


@pytest.mark.parametrize("seed", range(20))
def test_rows_after_a_prefix_with_errors_return_to_the_demonstrated_path(seed: int) -> None:
    train, draws = program("train"), torch.Generator().manual_seed(seed)
    horizon, limited = 12, 1.0 + 1e-6
    actions = torch.rand(50, horizon, 4, generator=draws) - 0.5
    lengths = torch.randint(0, 4, (50,), generator=draws)
    relative = torch.tensor([True, True, True, False]).expand(50, 4)
    rows = train.with_errors(actions, lengths, relative, draws)

    assert torch.equal(rows[lengths == 0], actions[lengths == 0])
    assert torch.equal(rows[..., 3], actions[..., 3])  # the gripper
    assert rows.abs().max() <= limited
    assert not torch.equal(rows[lengths > 0], actions[lengths > 0])
    # Errors of at most a few units are made up within the eight rows that follow a prefix.
    np.testing.assert_allclose(rows.sum(1), actions.sum(1), atol=1e-4)


def test_frames_before_an_intervention_count_the_rows_until_it() -> None:
    led = [False, False, True, True, False, True, False]
    waits, stops = program("train").corrections(led)
    assert waits == [2, 1, 0, 0, 1, 0, -1]
    assert stops[:6] == [4, 4, 4, 4, 6, 6]
