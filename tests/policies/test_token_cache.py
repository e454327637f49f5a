"""The tokens of instructions that are kept: equal to those of the tokenizer, in bounded memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from vlagents_ray.policies.token_cache import TokenCache, cached_tokenizer


class Counted:
    """Tokens are the characters; records the texts of each call."""

    def __init__(self) -> None:
        self.calls: list[list[str]] = []

    def __call__(self, texts: Sequence[str]) -> list[list[int]]:
        self.calls.append(list(texts))
        return [[ord(letter) for letter in text] for text in texts]


def cache_of(limit_bytes: int = 2**20) -> TokenCache[list[int]]:
    return TokenCache(lambda _: 1000, limit_bytes)


def test_each_text_is_tokenized_once_and_each_caller_gets_its_own() -> None:
    cache, plain, counted = cache_of(), Counted(), Counted()
    for texts in (["lift", "push"], ["push", "lift", "push"], ["Lift", "lift", "lift "]):
        assert cache.of(texts, counted) == plain(texts)
    assert counted.calls == [["lift", "push"], ["Lift", "lift "]]


def test_the_least_recently_used_text_is_dropped_first() -> None:
    cache, counted = cache_of(limit_bytes=2500), Counted()
    for text in ("a", "b", "a", "c", "a", "b"):
        cache.of([text], counted)
    assert counted.calls == [["a"], ["b"], ["c"], ["b"]]


def test_memory_stays_below_the_limit_also_if_one_batch_is_over_it() -> None:
    cache, counted = cache_of(limit_bytes=5000), Counted()
    for start in range(0, 100, 10):
        texts = [f"{start + i} pucks" for i in range(10)]
        assert cache.of(texts, counted) == Counted()(texts)
        assert 0 < cache.bytes <= 5000
    cache.of(["long" * 5000], counted)
    assert cache.bytes == 0


def test_an_error_is_not_kept() -> None:
    cache = cache_of()

    def fails(texts: Sequence[str]) -> list[list[int]]:
        raise ValueError(texts[0])

    with pytest.raises(ValueError, match="lift"):
        cache.of(["lift"], fails)
    assert cache.of(["lift"], Counted()) == Counted()(["lift"])


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

    cached = cached_tokenizer(tokenizer, max_length=8)
    for texts in (["lift"], ["push", "lift"], ["lift"], ["lift", "push", "lift"]):
        got, want = cached(texts), plain(texts)
        assert got.keys() == want.keys()
        assert all(torch.equal(got[name], want[name]) for name in want)
        got["input_ids"].zero_()
    assert sum(texts == ["push"] for texts in asked) == 1
