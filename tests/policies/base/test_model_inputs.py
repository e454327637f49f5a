"""Images of any size centred in black, and the tokens of instructions that are kept."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vlagents_ray.policies.base.model_inputs import KEPT, KEPT_CHARACTERS, keeping_tokens, resize_with_pad
from vlagents_ray.policies.lerobot.processors import cached_tokenizer


def test_a_wide_image_gets_bars_above_and_below() -> None:
    padded = resize_with_pad(np.full((50, 100, 3), 200, np.uint8), 224, 224)
    assert padded.shape == (224, 224, 3)
    assert (padded[56:168] == 200).all()
    assert not padded[:56].any()
    assert not padded[168:].any()


def test_a_tall_image_gets_bars_left_and_right() -> None:
    padded = resize_with_pad(np.full((100, 50, 3), 200, np.uint8), 224, 224)
    assert (padded[:, 56:168] == 200).all()
    assert not padded[:, :56].any()
    assert not padded[:, 168:].any()


def test_an_image_of_the_right_size_is_copied_as_it_is() -> None:
    image = np.random.default_rng(0).integers(0, 256, (224, 224, 3), dtype=np.uint8)
    same = resize_with_pad(image, 224, 224)
    np.testing.assert_array_equal(same, image)
    assert not np.shares_memory(same, image)


def test_a_sliver_keeps_a_row_of_pixels() -> None:
    assert resize_with_pad(np.full((1, 4000, 3), 9, np.uint8), 224, 224).any()


@pytest.mark.torch
def test_rows_of_tensors_are_those_of_the_tokenizer_and_changes_of_a_batch_do_not_reach_the_cache() -> None:
    torch = pytest.importorskip("torch")
    asked: list[list[str]] = []

    def tokenizer(texts: list[str], *, padding: str, return_tensors: str, max_length: int) -> dict[str, Any]:
        assert (padding, return_tensors) == ("max_length", "pt")
        asked.append(texts)
        ids = torch.tensor([[*map(ord, text), *[0] * (max_length - len(text))] for text in texts])
        return {"input_ids": ids, "attention_mask": (ids > 0).long()}

    def plain(texts: list[str]) -> dict[str, Any]:
        return tokenizer(texts, padding="max_length", return_tensors="pt", max_length=8)

    cached = cached_tokenizer(tokenizer, "cpu", max_length=8)
    for texts in (["lift"], ["push", "lift"], ["lift"], ["lift", "push", "lift"]):
        got, want = cached(texts), plain(texts)
        assert got.keys() == want.keys()
        assert all(torch.equal(got[name], want[name]) for name in want)
        got["input_ids"].zero_()
    assert sum(texts == ["push"] for texts in asked) == 1


def test_few_instructions_are_kept_and_none_that_is_very_long() -> None:
    asked: list[str] = []
    tokens = keeping_tokens(lambda text: asked.append(text) or [len(text)])
    long = "a" * (KEPT_CHARACTERS + 1)
    for text in ("lift", "lift", long, long):
        assert tokens(text) == [len(text)]
    assert asked == ["lift", long, long]
    for number in range(KEPT):
        tokens(f"lift {number}")
    tokens("lift")
    assert asked.count("lift") == 2, "the one used least recently was dropped"
