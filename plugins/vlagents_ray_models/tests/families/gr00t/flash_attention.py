"""flash-attention's results from plain products, so that NVIDIA's own policy class runs on a CPU.

Its N1.6 backbone has no other attention. Replaced are only the two functions that transformers and
NVIDIA's vision encoder call. Their arguments, such as the lengths of packed images, are NVIDIA's.
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
    query: torch.Tensor, key: torch.Tensor, value: torch.Tensor, scale: float, allowed: Any
) -> torch.Tensor:
    """Return the attention (…, T, D) of queries to the keys where `allowed` (…, T, S) is True, and
    zeros for queries without any key.
    """
    products = (query.float() @ key.float().transpose(-1, -2)) * scale
    weights = products.masked_fill(~allowed, float("-inf")).softmax(-1).nan_to_num(0.0)
    return (weights @ value.float()).to(query.dtype)


def causal(
    module: Any, query: Any, key: Any, value: Any, attention_mask: Any, scaling: float, **_: Any
) -> tuple[torch.Tensor, None]:
    """Attend in the language model: (B, heads, T, D) -> (B, T, heads, D), with padding where the
    mask (B, T) is 0.
    """
    groups = query.shape[1] // key.shape[1]
    allowed = torch.ones(query.shape[2], key.shape[2], dtype=torch.bool).tril()
    if attention_mask is not None:
        allowed = allowed & attention_mask.bool()[:, None, None, :]
    key = key.repeat_interleave(groups, dim=1)
    value = value.repeat_interleave(groups, dim=1)
    return attend(query, key, value, scaling, allowed).transpose(1, 2), None


def packed(
    query: Any, key: Any, value: Any, *_: Any, softmax_scale: float, cu_seq_lens_q: Any, **__: Any
) -> Any:
    """Attend in the vision encoder, (1, T, heads, D), where each token attends to its own image."""
    image = torch.bucketize(torch.arange(query.shape[1]), cu_seq_lens_q[1:], right=True)
    allowed = image[:, None] == image[None, :]
    query, key, value = (tensor.transpose(1, 2) for tensor in (query, key, value))
    return attend(query, key, value, softmax_scale, allowed).transpose(1, 2)
