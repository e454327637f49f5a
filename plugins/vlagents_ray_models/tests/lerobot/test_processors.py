"""The cache of the tokens of instructions."""

from __future__ import annotations

from typing import Any

import pytest

from vlagents_ray_models.lerobot.processors import cached_tokenizer


@pytest.mark.torch
def test_cached_tokens_are_the_tokenizers_and_changes_of_a_batch_do_not_reach_them() -> None:
    torch = pytest.importorskip("torch")
    tokenized: list[list[str]] = []

    def tokenizer(
        texts: list[str], *, padding: str, return_tensors: str, max_length: int
    ) -> dict[str, Any]:
        assert (padding, return_tensors) == ("max_length", "pt")
        tokenized.append(texts)
        ids = torch.tensor([[*map(ord, text), *[0] * (max_length - len(text))] for text in texts])
        return {"input_ids": ids, "attention_mask": (ids > 0).long()}

    def plain(texts: list[str]) -> dict[str, Any]:
        return tokenizer(texts, padding="max_length", return_tensors="pt", max_length=8)

    cached = cached_tokenizer(tokenizer, "cpu", max_length=8)
    for texts in (["lift"], ["push", "lift"], ["lift"], ["lift", "push", "lift"]):
        batch, expected = cached(texts), plain(texts)
        assert batch.keys() == expected.keys()
        assert all(torch.equal(batch[name], expected[name]) for name in expected)
        batch["input_ids"].zero_()
    assert sum(texts == ["push"] for texts in tokenized) == 1
