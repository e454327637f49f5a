"""Tokens of instructions, kept between acts: a session's instruction is the same at each of them."""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

from vlagents_ray.registry import require

T = TypeVar("T")

LIMIT_BYTES = 2**20  # thousands of instructions


class TokenCache(Generic[T]):
    """Keeps the results of one tokenizer by the exact text; the least recently used ones are dropped first.

    Tokens depend on no weights, so a push of weights leaves them. Only the policy's thread may use a cache.
    """

    def __init__(self, size: Callable[[T], int], limit_bytes: int = LIMIT_BYTES) -> None:
        """Make an empty cache.

        Args:
            size: The size of a result in bytes.
            limit_bytes: The size of all texts and results, at most.
        """
        self._size = size
        self._limit = limit_bytes
        self._kept: OrderedDict[str, T] = OrderedDict()
        self.bytes = 0

    def of(self, texts: Sequence[str], tokenize: Callable[[list[str]], Sequence[T]]) -> list[T]:
        """Return a result for each text; the caller must not change it.

        Args:
            texts: The texts.
            tokenize: Returns the results of texts that are not kept, in one call; its errors are not kept.
        """
        new = [text for text in dict.fromkeys(texts) if text not in self._kept]
        found = dict(zip(new, tokenize(new), strict=True)) if new else {}
        results = [found[text] if text in found else self._kept[text] for text in texts]
        for text in texts:
            if text in self._kept:
                self._kept.move_to_end(text)
        for text, result in found.items():
            self._kept[text] = result
            self.bytes += self._bytes(text, result)
        while self.bytes > self._limit:
            self.bytes -= self._bytes(*self._kept.popitem(last=False))
        return results

    def _bytes(self, text: str, result: T) -> int:
        return sys.getsizeof(text) + self._size(result)


def cached_tokenizer(tokenizer: Any, **settings: Any) -> Callable[[list[str]], dict[str, Any]]:
    """Return a function from texts to the tensors (B, L) of a tokenizer of transformers, which keeps their rows.

    All texts are padded to one length: a row that is padded to the longest text of its batch depends on the others.

    Args:
        tokenizer: The tokenizer.
        settings: Further arguments of its calls, such as `max_length`.
    """
    cache = TokenCache[dict[str, Any]](lambda row: sum(int(part.nbytes) for part in row.values()))

    def call(texts: list[str]) -> dict[str, Any]:
        def tokenize(new: list[str]) -> list[dict[str, Any]]:
            encoded = tokenizer(new, padding="max_length", return_tensors="pt", **settings)
            return [{name: values[i : i + 1].clone() for name, values in encoded.items()} for i in range(len(new))]

        rows = cache.of(texts, tokenize)
        return {name: require("torch").cat([row[name] for row in rows]) for name in rows[0]}

    return call
