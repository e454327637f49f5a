"""The training of the reference policy, from demonstrations that the usual commands record and
export.
"""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from vlagents_ray import Act
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.evaluate import EvalConfig, evaluate
from vlagents_ray.evaluate.results.reader import Results
from vlagents_ray.policies.scripted import Scripted
from vlagents_ray_results.lerobot import to_lerobot

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

ROOT = Path(__file__).parents[2]
CAMERAS = {"tabletop": {"scene": "front", "wrist": "wrist"}}


@pytest.fixture(scope="module")
def train() -> Any:
    """Import the training program under a name that no other program of a test uses."""
    spec = importlib.util.spec_from_file_location(
        "reference_training", ROOT / "examples/reference/train.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["reference_training"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return recordings of two episodes for each task and strength of disturbance in the folder's
    plan of demonstrations.
    """
    folder = tmp_path_factory.mktemp("data")
    plan = yaml.safe_load((ROOT / "examples/reference/demonstrations/tabletop.yaml").read_text())
    plan["suites"] = [suite | {"episodes": 2} for suite in plan["suites"]]
    plan["policies"] = [{"name": "expert"}]
    evaluate(EvalConfig(**plan | {"out": folder / "runs", "workers": 0}), agent_factory=Scripted)
    objects = ["puck", "target"]
    to_lerobot(
        Results.load(folder / "runs"),
        folder / "tabletop",
        successes=True,
        environment_state=objects,
    )
    return folder


def test_frames_are_those_that_were_recorded(train: Any, data: Path, tmp_path: Path) -> None:
    checkpoint, frames = train.read(data, CAMERAS, tmp_path / "images")
    assert set(checkpoint.words) > {"put", "slide", "stack", "lift", "puck", "pad"}
    robot = checkpoint.embodiments["tabletop"]
    assert (robot.state, robot.action["gripper_open"]) == (["xyzrpy", "gripper"], 1.0)
    assert frames.images.shape == (len(frames.state), 2, 64, 64, 3)
    assert frames.objects.shape == (len(frames.state), 6)
    _, some = train.read(data, CAMERAS, tmp_path / "some", every=3)
    assert len(some.place) == len(some.images) < len(frames.place) / 2
    assert np.array_equal(some.images, frames.images[some.place])
    assert frames.images[0, 0].std() > 10 < frames.images[0, 1].std()
    assert frames.action.abs().max() <= 1
    ends = frames.end.unique()
    assert int(ends[-1]) == len(frames.state)
    begins = torch.cat([torch.zeros(1, dtype=torch.int64), ends[:-1]])
    assert (frames.state[begins] == frames.state[0]).all()  # each episode begins at the same place
    assert frames.state.std(0)[:3].numpy() == pytest.approx(np.ones(3), abs=1e-2)


def test_a_training_that_was_cut_off_and_a_second_one_end_with_the_same_weights(
    train: Any, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "BATCH", 16)
    checkpoint, frames = train.read(data, CAMERAS, tmp_path / "images")
    monkeypatch.setattr(train, "KEEP_EVERY", 3)
    whole = train.fit(checkpoint, frames, 5, 0, tmp_path / "whole.pt")
    monkeypatch.setattr(train, "SHOWN_EVERY", 2)  # the progress output changes no weight
    other = train.fit(checkpoint, frames, 5, 1, tmp_path / "other.pt")

    def kept_and_cut(part: Path, kept: Path) -> None:
        part.rename(kept)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(train.os, "replace", kept_and_cut)
        with pytest.raises(KeyboardInterrupt):
            train.fit(checkpoint, frames, 5, 0, tmp_path / "cut.pt")
    again = train.fit(checkpoint, frames, 5, 0, tmp_path / "cut.pt")
    for name, value in whole.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name
    assert not torch.equal(other.queries, whole.queries)


def test_what_was_trained_is_served(
    train: Any, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vlagents_ray.policies.reference import Reference

    monkeypatch.setattr(train, "BATCH", 16)
    checkpoint, frames = train.read(data, CAMERAS, tmp_path / "images")
    train.save(
        checkpoint,
        train.fit(checkpoint, frames, 2, 0, tmp_path / "state.pt"),
        tmp_path / "checkpoint",
        {},
    )
    policy = Reference.from_config({"checkpoint": str(tmp_path / "checkpoint"), "execute": 4})
    policy.initialize()
    env = Tabletop("stack", width=64, height=64, cameras=("front", "wrist"))
    obs, _ = env.reset(seed=0)
    policy.reset(obs, env.instruction, seed=0)
    chunk = policy.act(obs).action
    assert chunk.shape == (4, 4)
    assert policy.contract.action == replace(env.contract.action, low=None, high=None)
    env.step(Act(chunk[0]))


@pytest.mark.parametrize(
    ("capability", "dtype"),
    [("AVX512", torch.bfloat16), ("AVX2", torch.float32), ("DEFAULT", torch.float32)],
)
def test_a_processor_without_avx512_computes_in_float32(
    train: Any, monkeypatch: pytest.MonkeyPatch, capability: str, dtype: Any
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    assert train.computing_dtype() == dtype
