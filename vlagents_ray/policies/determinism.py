"""`deterministic: true`: the check that a row's actions are equal to the bit whatever else is in its batch.

Kernels are chosen by the shapes of their arguments, and add numbers in another order for other shapes. So all batches
have one size. Whether each place of such a batch then computes alike depends on model, library and device: it is tried.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError

_INSTRUCTION = "go"
_OTHER = "warm up"  # longer, as some models pad instructions to the longest one


def require_deterministic(
    chunks: Callable[[Sequence[Any]], list[np.ndarray]], example: Callable[[int, str], Any], size: int
) -> None:
    """Compare the chunks of one row alone, and in the first and in the last place among others.

    Args:
        chunks: Computes the chunks (H, D) of rows, at most `size` of them.
        example: Makes a row with a seed and an instruction.
        size: The size of all batches.

    Raises:
        ConfigError: They differ.
    """

    def others() -> list[Any]:
        return [example(seed, _OTHER) for seed in range(1, size)]

    def own() -> Any:
        return example(0, _INSTRUCTION)

    alone, first, last = chunks([own()])[0], chunks([own(), *others()])[0], chunks([*others(), own()])[-1]
    if not (np.array_equal(alone, first) and np.array_equal(alone, last)):
        error = max(float(np.abs(alone - one).max()) for one in (first, last))
        raise ConfigError(
            f"deterministic: a row's actions change by up to {error:.2g} with the others in a batch of {size}; want "
            f"batch_sizes: [1] for this model on this device, or no `deterministic`"
        )
