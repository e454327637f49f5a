"""flash-attention's results by plain products, so that NVIDIA's own policy class runs on a CPU.

Its N1.6 backbone has no other attention. What stands in for the library are the two functions that
transformers and NVIDIA's vision tower call; what they are given, such as the lengths of packed
images, is NVIDIA's.
"""

from __future__ import annotations

import sys
from typing import Any

import pytest
import torch


def stand_in(patch: pytest.MonkeyPatch, model: Any) -> None:
    """Replace flash-attention in a loaded model of N1.6."""
    from transformers.modeling_utils import AttentionInterface

    vision = sys.modules[type(model.backbone.model.vision_model).__module__]
    patch.setattr(vision, "_flash_attention_forward", packed)
    patch.setitem(AttentionInterface._global_mapping, "flash_attention_2", causal)


def attend(
    query: torch.Tensor, key: torch.Tensor, value: torch.Tensor, scale: float, seen: Any
) -> torch.Tensor:
    """Attention (…, T, D) of queries to the keys that `seen` (…, T, S) has them see; zeros for
    those that see none.
    """
    products = (query.float() @ key.float().transpose(-1, -2)) * scale
    weights = products.masked_fill(~seen, float("-inf")).softmax(-1).nan_to_num(0.0)
    return (weights @ value.float()).to(query.dtype)


def causal(
    module: Any, query: Any, key: Any, value: Any, attention_mask: Any, scaling: float, **_: Any
) -> tuple[torch.Tensor, None]:
    """The language model's: (B, heads, T, D) -> (B, T, heads, D), with padding (B, T) where the
    mask is 0.
    """
    groups = query.shape[1] // key.shape[1]
    seen = torch.ones(query.shape[2], key.shape[2], dtype=torch.bool).tril()
    if attention_mask is not None:
        seen = seen & attention_mask.bool()[:, None, None, :]
    key, value = (one.repeat_interleave(groups, dim=1) for one in (key, value))
    return attend(query, key, value, scaling, seen).transpose(1, 2), None


def packed(
    query: Any, key: Any, value: Any, *_: Any, softmax_scale: float, cu_seq_lens_q: Any, **__: Any
) -> Any:
    """The vision tower's: (1, T, heads, D), each token sees those of its own image."""
    image = torch.bucketize(torch.arange(query.shape[1]), cu_seq_lens_q[1:], right=True)
    seen = image[:, None] == image[None, :]
    query, key, value = (one.transpose(1, 2) for one in (query, key, value))
    return attend(query, key, value, softmax_scale, seen).transpose(1, 2)
