"""The random steps of flow matching: their distribution, their log-probability, and the source of
their noise.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from normal_steps import logprob_of_steps

from vlagents_ray.policies import flow
from vlagents_ray.policies.base import Row
from vlagents_ray.policies.flow import (
    RandomSteps,
    chain_entropy,
    follow,
    logprob_of_chain,
    step_mean,
    step_std,
)

torch = pytest.importorskip("torch")
torch.set_num_threads(1)  # such small tensors are faster with one thread
pytestmark = pytest.mark.torch

STEPS, HORIZON, DIM, LEVEL = 5, 4, 3, 0.7
SHAPE = (STEPS, HORIZON, DIM)


def velocity(actions: Any, time: float) -> Any:
    """Return the velocity of a flow in which each number depends on the whole chunk."""
    return 0.3 * actions + 0.1 * actions.sum((1, 2), keepdim=True) - time


def row(seed: int, *want: str) -> Row:
    return Row((), "go", np.random.default_rng(seed), want=want)


def followed(rows: list[Row], level: float = LEVEL) -> tuple[Any, RandomSteps | None]:
    """Return the actions of rows, and their random steps."""
    actions = torch.from_numpy(np.stack([one.noise(HORIZON, DIM) for one in rows]))
    random = RandomSteps.for_rows(rows, SHAPE, level, torch.from_numpy)
    actions = follow(velocity, actions, STEPS, *([] if random is None else [random.change]))
    return actions, random


def stated(*rows: Row, execute: int | None = None, dim: int = DIM) -> dict[int, dict[str, Any]]:
    _, random = followed(list(rows))
    assert random is not None
    return random.outputs(execute, dim)


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_random_steps_lead_to_the_distribution_of_the_flow(level: float) -> None:
    mean, std, steps = 2.0, 0.3, 400
    x = np.random.default_rng(0).standard_normal(20_000)
    for step in range(steps):
        time = 1.0 - step / steps
        # For normal data: the expected noise minus the expected action, given x = time * noise + (1
        # - time) * action.
        gain = (x - (1 - time) * mean) / (time**2 + ((1 - time) * std) ** 2)
        change = time * gain - (mean + (1 - time) * std**2 * gain)
        drawn = np.random.default_rng([1, step]).standard_normal(len(x))
        x = step_mean(x, change, step, steps, level) + step_std(step, steps, level) * drawn
    assert x.mean() == pytest.approx(mean, abs=0.02)
    assert x.std() == pytest.approx(std, rel=0.05)


def test_steps_without_noise_are_those_of_the_flow() -> None:
    actions = torch.ones(2, HORIZON, DIM)
    change = velocity(actions, 0.6)
    assert torch.equal(step_mean(actions, change, 2, STEPS, 0.0), actions - change / STEPS)
    assert step_std(2, STEPS, 0.0) == 0.0


def test_the_log_probability_is_that_of_normal_steps_with_the_published_mean_and_noise() -> None:
    said = stated(row(0, "logprob", "replay"))[0]
    total = logprob_of_steps(velocity, said["replay"]["chain"], LEVEL)
    np.testing.assert_allclose(said["logprob"], total, atol=1e-3)


def test_a_replayed_chain_has_the_log_probability_that_was_stated() -> None:
    said = stated(row(0, "logprob", "replay"), row(1), row(2, "replay", "logprob"))
    assert list(said) == [0, 2]
    chain = torch.from_numpy(np.stack([one["replay"]["chain"] for one in said.values()]))
    again = logprob_of_chain(velocity, chain, said[0]["replay"]["noise_level"])
    np.testing.assert_allclose(
        again, np.stack([one["logprob"] for one in said.values()]), atol=1e-4
    )


def test_a_chain_begins_with_the_noise_and_ends_with_the_actions() -> None:
    rows = [row(0, "replay")]
    actions, random = followed(rows)
    assert random is not None
    chain = random.outputs(None, DIM)[0]["replay"]["chain"]
    assert chain.shape == (STEPS + 1, HORIZON, DIM)
    np.testing.assert_array_equal(chain[0], row(0).noise(HORIZON, DIM))
    np.testing.assert_array_equal(chain[-1], actions[0])


def test_a_step_of_a_learner_makes_a_chain_likelier() -> None:
    chain = torch.from_numpy(stated(row(0, "replay"))[0]["replay"]["chain"])[None]
    weight = torch.tensor(0.5, requires_grad=True)

    def trained(actions: Any, time: float) -> Any:
        return weight * velocity(actions, time)

    before = logprob_of_chain(trained, chain, LEVEL).sum()
    before.backward()
    with torch.no_grad():
        weight += 1e-4 * weight.grad.sign()
        assert logprob_of_chain(trained, chain, LEVEL).sum() > before


def test_neighbours_neither_change_what_is_drawn_nor_are_changed() -> None:
    alone, _ = followed([row(3, "logprob")])
    plain, nothing = followed([row(4)])
    together, _ = followed([row(4), row(5, "entropy"), row(3, "logprob")])
    assert nothing is None
    np.testing.assert_array_equal(together[2], alone[0])
    np.testing.assert_array_equal(together[0], plain[0])


def test_what_is_not_returned_has_no_part_in_the_log_probability() -> None:
    whole, part = (
        stated(row(0, "logprob", "entropy"), **used)[0] for used in ({}, {"execute": 2, "dim": 1})
    )
    np.testing.assert_array_equal(part["logprob"], whole["logprob"][:2, :1])
    assert part["entropy"] == pytest.approx(whole["entropy"] / (HORIZON * DIM / 2))


def test_the_entropy_is_the_expected_negative_log_probability() -> None:
    total = np.mean([stated(row(seed, "logprob"))[0]["logprob"].mean() for seed in range(300)])
    assert -total == pytest.approx(chain_entropy(STEPS, LEVEL), abs=0.15)


def test_only_what_is_wanted_is_stated() -> None:
    assert list(stated(row(0, "entropy"))[0]) == ["entropy"]


def test_no_statement_imports_from_the_lazy_module() -> None:
    """`torch.compile` of torch 2.11 cannot trace an import from `transformers` itself; `require` is
    for the code around it.
    """
    package = Path(flow.__file__).parent
    assert not [
        file for file in package.rglob("*.py") if "from transformers import" in file.read_text()
    ]
