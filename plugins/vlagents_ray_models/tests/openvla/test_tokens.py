"""The distribution over action tokens: draws, log-probability and entropy."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vlagents_ray_models.openvla.prismatic import ActionBins

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

VOCABULARY, BINS = 40, 8  # the last tokens but four are bins
LAST = VOCABULARY - 4 - 1


@pytest.fixture
def bins() -> ActionBins:
    sizes = SimpleNamespace(vocab_size=VOCABULARY)
    return ActionBins(
        SimpleNamespace(n_action_bins=BINS, text_config=sizes, pad_to_multiple_of=4),
        torch.device("cpu"),
    )


def logits(*shape: int, seed: int = 0) -> Any:
    return torch.randn(*shape, VOCABULARY, generator=torch.Generator().manual_seed(seed))


def test_the_log_probability_is_that_of_the_bins_alone(bins: ActionBins) -> None:
    scores = logits(3, 2)
    tokens = torch.tensor([[LAST, LAST - 1], [LAST - 7, LAST], [LAST - 3, LAST - 4]])
    categorical = torch.distributions.Categorical(
        logits=scores[..., range(LAST - BINS + 1, LAST + 1)].double()
    )
    _, bin_logits = bins.read(scores)
    *_, logprob, entropy, described_tokens = bins.describe(tokens, bin_logits)

    np.testing.assert_allclose(logprob, categorical.log_prob(tokens - (LAST - BINS + 1)), rtol=1e-9)
    np.testing.assert_allclose(entropy, categorical.entropy(), rtol=1e-9)
    np.testing.assert_allclose(bins.logprob(tokens, scores), logprob, rtol=1e-9)
    np.testing.assert_array_equal(described_tokens, tokens)


def test_tokens_are_drawn_as_often_as_their_log_probability_says(bins: ActionBins) -> None:
    scores = logits(1).expand(20_000, -1)
    tokens = bins.choose(*bins.read(scores), torch.tensor(np.random.default_rng(0).random(20_000)))
    for token, times in zip(*tokens.unique(return_counts=True), strict=True):
        share = bins.logprob(token[None], scores[:1]).exp().item()
        assert times.item() / 20_000 == pytest.approx(share, abs=5 * (share / 20_000) ** 0.5)


def test_a_bin_that_is_impossible_adds_no_entropy(bins: ActionBins) -> None:
    scores = torch.full((1, VOCABULARY), -1e9)
    scores[0, [LAST, LAST - 1]] = 0.0
    _, bin_logits = bins.read(scores)
    *_, entropy, _ = bins.describe(torch.tensor([LAST]), bin_logits)
    assert entropy.item() == pytest.approx(np.log(2))


def test_a_learner_follows_the_gradient_of_the_log_probability(bins: ActionBins) -> None:
    scores = logits(2).requires_grad_()
    tokens = torch.tensor([LAST, LAST - 2])
    before = bins.logprob(tokens, scores)
    before.sum().backward()
    assert (bins.logprob(tokens, scores.detach() + 0.1 * scores.grad) > before).all()


def test_the_likeliest_token_may_be_a_word_and_counts_as_the_nearest_bin(bins: ActionBins) -> None:
    scores = logits(1)
    scores[0, 3] = 100.0  # a word, before all bins, of which the first token is the highest
    likeliest, bin_logits = bins.read(scores)
    assert bins.choose(likeliest, bin_logits, torch.tensor([torch.nan])).tolist() == [3]
    highest = bins.describe(torch.tensor([LAST - BINS + 1]), bin_logits)
    np.testing.assert_array_equal(bins.describe(likeliest, bin_logits)[:5], highest[:5])
