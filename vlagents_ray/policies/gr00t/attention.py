"""Attention of GR00T's backbones where flash-attention is missing, as on a CPU."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

from vlagents_ray.registry import require

_FLASH, _PACKED = "flash_attention_2", "packed_sdpa"
_CHECK = "_check_and_enable_flash_attn_2"  # of transformers' models, up to 4.5


def flash_attention_is_here(device: Any, dtype: Any) -> bool:
    """Whether flash-attention is installed, and computes on a device in a dtype: on CUDA, in 16 bits."""
    computes = device.type == "cuda" and dtype.itemsize == 2
    return computes and bool(require("transformers.utils").is_flash_attn_2_available())


@contextlib.contextmanager
def built_without_flash_attention() -> Iterator[None]:
    """Let models be built in this context that insist on flash-attention, as N1.6's backbone does."""
    base: Any = require("transformers").PreTrainedModel
    check = vars(base).get(_CHECK)
    if check is None:  # newer: N1.7's, which takes another attention by itself
        yield
        return
    setattr(base, _CHECK, classmethod(lambda _, config, *__, **___: config))
    try:
        yield
    finally:
        setattr(base, _CHECK, check)


def use_torch_attention(model: Any) -> None:
    """Have the parts of a model that ask for flash-attention use torch's own.

    N1.6's vision tower attends within each of several images that follow each other in one sequence.
    """
    transformers = require("transformers.modeling_utils")
    for module in model.modules():
        config: Any = getattr(module, "config", None)
        if config is not None and getattr(config, "_attn_implementation", None) == _FLASH:
            packed = config.model_type.startswith("siglip2")
            config._attn_implementation = _PACKED if packed else "sdpa"
    transformers.AttentionInterface.register(_PACKED, packed_attention)


def packed_attention(
    _: Any, query: Any, key: Any, value: Any, __: Any = None, *, scaling: float, seq_len_list: Sequence[int], **___: Any
) -> tuple[Any, None]:
    """Attend within each of several sequences that follow each other.

    Args:
        query: (1, heads, tokens, D).
        key: As `query`.
        value: As `query`.
        scaling: The factor of the products of queries and keys.
        seq_len_list: The number of tokens of each sequence.

    Returns:
        (1, tokens, heads, D), and None in place of the weights.
    """
    attention = require("torch.nn.functional").scaled_dot_product_attention
    if len(set(seq_len_list)) == 1:  # in one call, each sequence a row
        rows = [one[0].unflatten(1, (-1, seq_len_list[0])).transpose(0, 1) for one in (query, key, value)]
        return attention(*rows, scale=scaling).transpose(1, 2).flatten(0, 1)[None], None
    parts = zip(*(one.split(list(seq_len_list), dim=2) for one in (query, key, value)), strict=True)
    return require("torch").cat([attention(*part, scale=scaling) for part in parts], dim=2).transpose(1, 2), None
