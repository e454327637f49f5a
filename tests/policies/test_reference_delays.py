"""The training of the reference policy for late answers, with an expert in the simulator."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reactive import expert_action

from vlagents_ray import Act
from vlagents_ray.envs.tabletop import Tabletop

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

REFERENCE = Path(__file__).parents[2] / "examples" / "reference"
LONGEST = 3  # rows
HORIZON = 8


@pytest.fixture(scope="module")
def delays() -> Any:
    """Import the program, and the training of the same folder that it uses."""
    for name in ("train", "delays"):
        spec = importlib.util.spec_from_file_location(name, REFERENCE / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    yield sys.modules["delays"]
    del sys.modules["delays"], sys.modules["train"]


@pytest.mark.parametrize("seed", range(8))
def test_labels_are_what_the_expert_does_after_the_given_rows(delays: Any, seed: int) -> None:
    env = Tabletop(width=32, height=32, object_state=True)
    obs, _ = env.reset(seed=seed)
    env.looked_at = False
    rng = np.random.default_rng(seed)
    for _ in range(int(rng.integers(8))):
        obs, *_ = env.step(Act(expert_action(obs, env.instruction)))
    prefix = rng.uniform(-1, 1, (int(rng.integers(LONGEST + 1)), 4)).astype(np.float32)
    label = delays.continued(env, prefix, HORIZON)
    np.testing.assert_array_equal(label[: len(prefix)], prefix)
    for row in range(HORIZON):  # The copy did not change the environment.
        if row >= len(prefix):
            np.testing.assert_array_equal(expert_action(obs, env.instruction), label[row])
        obs, *_ = env.step(Act(label[row]))


def test_a_small_training_gives_a_policy_that_continues_given_rows(
    delays: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delays.train, "BATCH", 32)
    out, start = tmp_path / "checkpoint", REFERENCE / "pretrained"
    threads = torch.get_num_threads()
    delays.main(start, out, LONGEST, (4, 4), (2, 2), (1e-4, 1e-4))
    torch.set_num_threads(threads)

    before = delays.train.read_checkpoint(start)
    after = delays.train.read_checkpoint(out)
    assert after.sizes == before.sizes.model_copy(update={"longest_prefix": LONGEST})
    assert list(after.embodiments) == ["tabletop"]
    old = delays.train.read_network(before.sizes, start).state_dict()
    new = delays.train.read_network(after.sizes, out).state_dict()
    changed = {name.partition(".")[0] for name in old if not torch.equal(old[name], new[name])}
    assert changed == set(delays.train.HEAD) - {"given"}
    assert new["given.2.weight"].any()


def test_labels_become_frames_with_their_own_rows(delays: Any) -> None:
    labels = delays.Labels()
    message = delays.gather(REFERENCE / "pretrained", labels, 3, 6_000_000, LONGEST)
    frames = labels.frames()
    assert message.endswith("of 3 episodes solved")
    assert set(labels.given) == set(range(LONGEST + 1))
    for i, place in enumerate(frames.place.tolist()):
        assert frames.given[place] == labels.given[i]
        assert int(frames.end[place]) == place + HORIZON
        np.testing.assert_array_equal(frames.action[place : place + HORIZON], labels.rows[i])
    assert frames.action.abs().max() <= 1 + 1e-6
