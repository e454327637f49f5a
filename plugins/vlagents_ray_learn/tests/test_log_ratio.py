"""How far a learner's log-probabilities are from the server's."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray.errors import InvalidInput
from vlagents_ray_learn import log_ratio


def test_an_act_is_a_row_whose_numbers_are_summed() -> None:
    server = np.zeros((3, 2, 2), np.float32)
    learner = server.copy()
    learner[0, :, 0] = 1.0
    found = log_ratio(learner, server)
    assert (found.acts, found.mean) == (3, pytest.approx(2 / 3))
    assert found.std == pytest.approx(np.std([2, 0, 0]))
    assert log_ratio(server, server).std == 0


def test_steps_without_an_act_are_left_out() -> None:
    assert log_ratio(np.ones(3), np.array([0, np.nan, 0])).acts == 2
    with pytest.raises(InvalidInput, match=r'request them with want=\["logprob"\]'):
        log_ratio(np.ones(1), np.array([np.nan]))
    with pytest.raises(InvalidInput, match=r"got \(2,\) and \(2, 1\)"):
        log_ratio(np.ones(2), np.ones((2, 1)))


@pytest.mark.torch
def test_a_flow_in_another_type_than_the_learners_shows_in_the_deviation() -> None:
    import torch

    from vlagents_ray.policies.flow import logprob_of_chain

    generator = torch.Generator().manual_seed(0)
    chain = torch.randn(32, 5, 10, 7, generator=generator)  # 4 steps, 10 actions of 7 numbers
    weights = torch.randn(7, 7, generator=generator) / 7

    def logprob(dtype: torch.dtype) -> torch.Tensor:
        def velocity(actions: torch.Tensor, time: float) -> torch.Tensor:
            return torch.tanh(actions.to(dtype) @ weights.to(dtype)).float()

        return logprob_of_chain(velocity, chain, noise_level=0.5)

    server = logprob(torch.bfloat16).numpy()
    assert log_ratio(logprob(torch.bfloat16), server).std == 0
    assert 0 < log_ratio(logprob(torch.float32), server).std < 1
    assert log_ratio(logprob(torch.float32).bfloat16(), server).std > 0, "tensors of any type"
