"""DAgger with the reference policy: an expert's corrections, and training on these alone."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

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
