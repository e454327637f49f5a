"""Keys and values of a transformers cache as one tensor, which a compiled core can take and
return.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def layers_of(cache: Any) -> list[tuple[Any, Any]]:
    """Return keys and values of each layer of a transformers `DynamicCache`; its versions differ
    in where they are.
    """
    if hasattr(cache, "layers"):
        return [(layer.keys, layer.values) for layer in cache.layers]
    return [cache[number] for number in range(len(cache))]


def stack_of(layers: Sequence[tuple[Any, Any]]) -> Any:
    """Return the keys and values (B, heads, L, E) of each layer in one tensor (B, layers, 2,
    heads, L, E).
    """
    import torch  # the compiler follows a statement, and not `require`

    return torch.stack([torch.stack(layer, 1) for layer in layers], 1)


def cache_of(layers: Sequence[Any]) -> Any:
    """Return a transformers `DynamicCache` with these keys and values, (B, 2, …) for each layer."""
    # The compiler follows a statement, and not `require`; nor does it follow the lazy module
    # `transformers` itself.
    from transformers.cache_utils import DynamicCache

    cache = DynamicCache()
    for number, layer in enumerate(layers):
        cache.update(layer[:, 0], layer[:, 1], number)
    return cache
