"""Random numbers of a session for models that draw from torch's global generator."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch.overrides import TorchFunctionMode

_SEEDS = 2**63


def generator_of(rng: np.random.Generator) -> Any:
    """Make a torch generator seeded from `rng`, on the CPU so that draws are the same on every device."""
    return torch.Generator().manual_seed(int(rng.integers(_SEEDS)))


@contextlib.contextmanager
def seeded(rng: np.random.Generator, device: Any) -> Iterator[None]:
    """Seed torch's global generators from `rng` within the context, and restore their state afterwards."""
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(int(rng.integers(_SEEDS)))
        yield


class RowDraws(TorchFunctionMode):  # type: ignore[misc]
    """A context in which `torch.randn` and `torch.multinomial` draw each row of a batch from that row's generator.

    The batch must be the first dimension of every draw, or the outer part of that dimension. Draws of other threads are
    not affected.
    """

    def __init__(self, rngs: Sequence[np.random.Generator]) -> None:
        super().__init__()
        self._generators = [generator_of(rng) for rng in rngs]

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        draw: Callable[..., Any] = {torch.randn: self._randn, torch.multinomial: self._multinomial}.get(func, func)
        return draw(*args, **(kwargs or {}))

    def _randn(self, *sizes: Any, size: Any = None, device: Any = None, dtype: Any = None, **_: Any) -> Any:
        given = size or (sizes[0] if len(sizes) == 1 and not isinstance(sizes[0], int) else sizes)
        batch, *shape = given
        each = batch // len(self._generators)
        rows = [torch.randn(each, *shape, generator=generator) for generator in self._generators]
        return torch.cat(rows).to(device=device, dtype=dtype)

    def _multinomial(self, weights: Any, num_samples: int) -> Any:
        blocks = weights.float().cpu().chunk(len(self._generators))
        drawn = [
            torch.multinomial(block, num_samples, generator=generator)
            for block, generator in zip(blocks, self._generators, strict=True)
        ]
        return torch.cat(drawn).to(weights.device)
