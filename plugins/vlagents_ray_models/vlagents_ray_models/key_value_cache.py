"""Conversion of a transformers key-value cache to one tensor, which a compiled core can accept and
return.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def layers_of(cache: Any) -> list[tuple[Any, Any]]:
    """Return the keys and values of a transformers `DynamicCache` of any version.

    Args:
        cache: The cache.

    Returns:
        The keys and values of each layer, (B, heads, L, E) each.
    """
    if hasattr(cache, "layers"):  # in newer versions
        return [(layer.keys, layer.values) for layer in cache.layers]
    return [cache[number] for number in range(len(cache))]


def stack_of(layers: Sequence[tuple[Any, Any]]) -> Any:
    """Stack the keys and values of all layers.

    Args:
        layers: The keys and values of each layer, (B, heads, L, E) each.

    Returns:
        One tensor, (B, layers, 2, heads, L, E).
    """
    import torch  # torch's compiler follows this statement, but not `require`

    return torch.stack([torch.stack(layer, 1) for layer in layers], 1)


def cache_of(layers: Sequence[Any]) -> Any:
    """Make a transformers `DynamicCache`.

    Args:
        layers: Keys and values of each layer in one tensor, (B, 2, heads, L, E).

    Returns:
        The cache, which contains them.
    """
    # Torch's compiler follows this statement, but neither `require` nor the lazy module
    # `transformers` itself.
    from transformers.cache_utils import DynamicCache

    cache = DynamicCache()
    for number, layer in enumerate(layers):
        cache.update(layer[:, 0], layer[:, 1], number)
    return cache
