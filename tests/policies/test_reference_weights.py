"""The weights of the reference policy in this repository: their success rates match the
model card.
"""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from vlagents_ray.evaluate import EvalConfig, Results, SuiteConfig, evaluate
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.local_agent import LocalPolicy
from vlagents_ray.success import read_curves, wilson
from vlagents_ray_results.verification import verify

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

ROOT = Path(__file__).parents[2]
CHECKPOINT = ROOT / "examples/reference/checkpoint"
LATE = ROOT / "examples/reference/late_answers"
RATES = json.loads((CHECKPOINT / "rates.json").read_text())
EPISODES = 20
AT_ONCE = 10  # a batch of ten takes hardly longer than a batch of one
TASKS = [env for env, (solved, episodes) in RATES["tabletop"].items() if solved / episodes > 0.8]


def test_they_are_small_enough_for_a_repository() -> None:
    assert (CHECKPOINT / "model.safetensors").stat().st_size < 20e6
    assert sum(file.stat().st_size for file in CHECKPOINT.iterdir()) < 25e6
    assert sum(file.stat().st_size for file in LATE.iterdir()) < 20e6


def test_the_curves_of_late_answers_are_of_its_weights_and_in_its_card() -> None:
    curves = read_curves(LATE)
    card = (LATE / "README.md").read_text(encoding="utf-8")
    config = {"checkpoint": str(LATE), "embodiment": "tabletop"}
    policy = LocalPolicy(ServerArgs(policy="reference", config=config), config)
    policy.initialize()
    digest = policy.metadata["weights"]["digest"]
    assert len(curves) == 2
    for curve in curves:
        assert curve.weights == digest
        for solved in curve.solved.values():
            low, high = wilson(solved.solved, solved.episodes)
            rate = (
                f"{100 * solved.solved / solved.episodes:.1f} [{100 * low:.0f}, {100 * high:.0f}]"
            )
            assert rate in card


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Let torch use one thread, since its batches are too small to share, and other tests run at
    the same time.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.usefixtures("one_thread")
def test_the_checkpoint_for_late_answers_succeeds_at_three_rows_of_delay(tmp_path: Path) -> None:
    options: dict[str, Any] = {"cameras": ["front", "wrist"], "width": 64, "height": 64}
    clock = {"latency": 0.3, "mode": "async", "real_time_chunking": True, "fresh_grip": None}
    suite = SuiteConfig(
        envs=["tabletop"],
        env_options={**options, "ends_on_success": True},
        episodes=2 * EPISODES,
        seeds=[10_000],
        num_envs=AT_ONCE,
        clock=clock,
    )
    policies = [{"name": "reference", "execute": 4}]
    plan = EvalConfig(policies=policies, suites=[suite], out=tmp_path, video="none", workers=0)
    config = {"checkpoint": str(LATE), "embodiment": "tabletop"}
    args = ServerArgs(policy="reference", config=config, batch={"max_size": AT_ONCE})
    found = evaluate(plan, agent_factory=lambda: LocalPolicy(args, config)).total
    # 244 of 250 were measured. The bound is four standard deviations lower.
    assert found.success_once.successes / (2 * EPISODES) >= 0.976 - 0.1


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("env", TASKS)
def test_they_succeed_as_often_as_their_card_says(env: str, tmp_path: Path) -> None:
    solved, episodes = RATES["tabletop"][env]
    options: dict[str, Any] = {"cameras": ["front", "wrist"], "width": 64, "height": 64}
    # No evaluation uses these seeds.
    suite = SuiteConfig(
        envs=[env], env_options=options, episodes=EPISODES, seeds=[10_000], num_envs=AT_ONCE
    )
    plan = EvalConfig(
        policies=[{"name": "reference", "execute": 4}],
        suites=[suite],
        out=tmp_path,
        video="none",
        workers=0,
    )
    config = {"checkpoint": str(CHECKPOINT), "embodiment": "tabletop"}
    args = ServerArgs(policy="reference", config=config, batch={"max_size": AT_ONCE})
    found = evaluate(plan, agent_factory=lambda: LocalPolicy(args, config)).total
    assert (
        found.success_once.successes / EPISODES >= wilson(solved, episodes)[0] - 0.15
    )  # 30 episodes, with a standard deviation of 0.05
    [case] = Results.load(tmp_path).cases
    assert len({one.actions_sha256 for one in case.counted}) == EPISODES


def test_their_card_and_rates_are_those_of_their_bundles(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location(
        "reference_card", ROOT / "examples/reference/card.py"
    )
    assert spec is not None
    assert spec.loader is not None
    card = sys.modules["reference_card"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(card)
    shutil.copytree(CHECKPOINT, tmp_path / "checkpoint")
    evaluations = []
    for name in ("tabletop", "tabletop_misled", "metaworld", "metaworld_misled"):
        into = tmp_path / name
        verify(CHECKPOINT / f"{name}.bundle.zip", replay=0, into=into)
        evaluations.append(into)
    card.main(tmp_path / "checkpoint", evaluations)
    for name in ("README.md", "rates.json"):
        assert (tmp_path / "checkpoint" / name).read_text() == (CHECKPOINT / name).read_text()
