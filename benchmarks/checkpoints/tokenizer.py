"""A byte-level tokenizer, which is trained here, since the published tokenizers would be
downloaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vlagents_ray.registry import require

SENTENCES = ("pick up the cube\n", "open the drawer\n")
SPECIAL = {"pad_token": "<pad>", "bos_token": "<bos>", "eos_token": "<eos>"}


def byte_level(
    special: Sequence[str], sentences: Sequence[str] = SENTENCES, vocabulary: int = 300
) -> Any:
    """Train a `tokenizers.Tokenizer` of bytes and the frequent parts of a few sentences.

    Args:
        special: The special tokens, whose ids are 0, 1, 2, ….
        sentences: The training text.
        vocabulary: The number of tokens, at most.
    """
    tokenizers = require("tokenizers")
    tokenizer = tokenizers.Tokenizer(tokenizers.models.BPE())
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = tokenizers.decoders.ByteLevel()
    trainer = tokenizers.trainers.BpeTrainer(
        vocab_size=vocabulary,
        special_tokens=list(special),
        initial_alphabet=tokenizers.pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )
    tokenizer.train_from_iterator(sentences, trainer)
    return tokenizer


def fast_tokenizer(tokens: Any = None, **named: Any) -> Any:
    """Return transformers' tokenizer with the special tokens `named`, or `SPECIAL`; `tokens` is a
    tokenizer of `byte_level`.
    """
    named = named or SPECIAL
    tokens = byte_level(list(SPECIAL.values())) if tokens is None else tokens
    return require("transformers").PreTrainedTokenizerFast(tokenizer_object=tokens, **named)
