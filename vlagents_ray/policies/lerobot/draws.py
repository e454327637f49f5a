"""Random numbers that belong to a session, inside models that draw from torch's global generator."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch.overrides import TorchFunctionMode

_SEEDS = 2**63


def generator_of(rng: np.random.Generator) -> Any:
    """A torch generator on the CPU, so that the draws are the same on every device; it advances `rng`."""
    return torch.Generator().manual_seed(int(rng.integers(_SEEDS)))


@contextlib.contextmanager
def seeded(rng: np.random.Generator, device: Any) -> Iterator[None]:
    """Torch's global generators begin at a seed of `rng` here, and go on afterwards as if nothing had been drawn."""
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(int(rng.integers(_SEEDS)))
        yield


class RowDraws(TorchFunctionMode):  # type: ignore[misc]
    """Within it, `torch.randn` and `torch.multinomial` draw each row of a batch from that row's generator.

    For models whose batch is the first dimension of all that they draw, alone or as the outer part of it. Another
    thread's draws are not touched.
    """

    def __init__(self, rngs: Sequence[np.random.Generator]) -> None:
        super().__init__()
        self._generators = [generator_of(rng) for rng in rngs]

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        draw: Callable[..., Any] = {torch.randn: self._randn, torch.multinomial: self._multinomial}.get(func, func)
        return draw(*args, **(kwargs or {}))

    def _randn(self, *size: Any, device: Any = None, dtype: Any = None) -> Any:
        batch, *shape = size[0] if len(size) == 1 and not isinstance(size[0], int) else size
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
