"""Draws of a model's code from the generators of its rows."""

from __future__ import annotations

import sys
import threading
from typing import Any

import numpy as np
import pytest

from vlagents_ray.errors import PolicyFailed
from vlagents_ray.policies.base import Row

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch


@pytest.fixture
def model() -> Any:
    from drawing_model import Tuned

    return Tuned()


def rngs(*seeds: int) -> list[np.random.Generator]:
    return [np.random.default_rng(seed) for seed in seeds]


def test_each_row_has_the_numbers_that_it_has_alone(model: Any) -> None:
    from vlagents_ray_models.sampling_rng import RowDraws, generator_of

    with RowDraws(rngs(1, 2), model):
        noise, chosen = model.draw(4)  # two rows of each session
    generator = generator_of(np.random.default_rng(2))
    expected_noise = (
        torch.randn(2, 3, generator=generator).bfloat16().float(),
        torch.randn(2, 2, generator=generator),
    )
    assert torch.equal(noise[2:], torch.cat(expected_noise, 1))
    assert torch.equal(chosen[2:], torch.multinomial(torch.ones(2, 50), 1, generator=generator))

    with RowDraws(rngs(2), model):
        noise_alone, chosen_alone = model.draw(2)
    assert torch.equal(noise_alone, noise[2:])
    assert torch.equal(chosen_alone, chosen[2:])


def test_only_the_models_own_draws_in_the_context_are_the_rows(model: Any) -> None:
    from vlagents_ray_models.sampling_rng import RowDraws

    def draws_from_torch(draw: Any) -> bool:
        """Return whether a function draws from torch's global generator."""
        torch.manual_seed(0)
        drawn = draw()
        torch.manual_seed(0)
        return torch.equal(drawn, torch.randn((2, 3), dtype=torch.bfloat16).float())

    in_thread: list[bool] = []
    with RowDraws(rngs(1, 2), model):
        # Each call of torch would pass through such a mode.
        assert torch.overrides._get_current_function_mode() is None
        assert draws_from_torch(lambda: torch.randn((2, 3), dtype=torch.bfloat16).float())
        thread = threading.Thread(
            target=lambda: in_thread.append(draws_from_torch(lambda: model.draw(2)[0][:, :3]))
        )
        thread.start()
        thread.join()
        assert not draws_from_torch(lambda: model.draw(2)[0][:, :3])
    assert in_thread == [True]
    assert draws_from_torch(lambda: model.draw(2)[0][:, :3])
    assert torch.nn.modules.linear.torch is torch.nn.modules.module.torch is torch


def test_draws_that_are_no_rows_own_are_refused(model: Any) -> None:
    from vlagents_ray_models.sampling_rng import RowDraws, RowNoise

    with (
        RowDraws(rngs(1, 2), model),
        pytest.raises(PolicyFailed, match="drew from rand: its actions would depend"),
    ):
        model.draw_otherwise()
    with (
        pytest.raises(PolicyFailed, match="drew no numbers for its rows"),
        RowDraws(rngs(1), model),
    ):
        pass
    with (
        RowNoise([Row((), "", rng) for rng in rngs(1, 2)], 1, model),
        pytest.raises(PolicyFailed, match="one row for"),
    ):
        model.draw(3)


@pytest.mark.parametrize("ahead", [1, 3, 4])
def test_noise_made_ahead_is_that_made_one_by_one(model: Any, ahead: int) -> None:
    from vlagents_ray_models.sampling_rng import RowNoise

    rows = [Row((), "", rng) for rng in rngs(1, 2)]
    proxy = sys.modules["drawing_model"]
    with RowNoise(rows, ahead, model):
        drawn = [proxy.torch.randn((2, 5, 3)) for _ in range(4)]

    generators = rngs(1, 2)
    expected = []
    for rng in generators:
        expected.append([rng.standard_normal((5, 3), dtype=np.float32) for _ in range(4)])
    np.testing.assert_array_equal(torch.stack(drawn, 1).numpy(), expected)
    # No more was drawn.
    assert [row.rng.random() for row in rows] == [rng.random() for rng in generators]
