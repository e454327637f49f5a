"""Random numbers of a session for models that draw from torch's global generator."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextvars import ContextVar, Token
from functools import cached_property, partial
from types import ModuleType
from typing import Any

import numpy as np
import torch
from typing_extensions import Self

from vlagents_ray.errors import PolicyFailed
from vlagents_ray.policies.base import Row

_SEEDS = 2**63
# Of the pass of this thread.
_DRAWS: ContextVar[RowDraws | None] = ContextVar("draws", default=None)


def generator_of(rng: np.random.Generator) -> Any:
    """Make a torch generator seeded from `rng`, on the CPU so that draws are the same on every
    device.
    """
    return torch.Generator().manual_seed(int(rng.integers(_SEEDS)))


@contextlib.contextmanager
def seeded(rng: np.random.Generator, device: Any) -> Iterator[None]:
    """Seed torch's global generators from `rng` within the context, and restore their state
    afterwards.
    """
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(int(rng.integers(_SEEDS)))
        yield


class RowDraws:
    """A context in which a model's code draws each row of a batch from that row's generator.

    Only the modules that define the model's own class draw so, by `torch.randn` and
    `torch.multinomial`; they may not draw otherwise. Layers and other threads run as always:
    torch's function modes, which reach all code, make each call of torch slower by half. The batch
    must be the first dimension of every draw, or the outer part of that dimension.
    """

    def __init__(self, rngs: Sequence[np.random.Generator], *models: Any) -> None:
        """Prepare to draw from the generator of each row in the code of these objects, or
        modules, from now on.
        """
        self._rngs, self._drawn = rngs, False
        for model in models:
            names = [kind.__module__ for kind in type(model).__mro__]
            modules: Iterable[Any] = (
                [model] if isinstance(model, ModuleType) else map(sys.modules.get, names)
            )
            for module in modules:
                if getattr(module, "torch", None) is torch and not module.__name__.startswith(
                    "torch."
                ):
                    module.torch = _TORCH

    def __enter__(self) -> Self:
        self._token: Token[RowDraws | None] = _DRAWS.set(self)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        _DRAWS.reset(self._token)
        if kind is None and not self._drawn:
            raise PolicyFailed(
                "the model drew no numbers for its rows; is its code of the version that is "
                "required?"
            )

    @cached_property
    def _generators(self) -> list[Any]:
        return [generator_of(rng) for rng in self._rngs]

    def draw(self, name: str, *args: Any, **options: Any) -> Any:
        """Draw as the function `name` of torch does."""
        self._drawn = True
        if name == "multinomial":
            return self._multinomial(*args, **options)
        if name != "randn":
            raise PolicyFailed(
                f"the model drew from {name}: its actions would depend on its neighbours'"
            )
        sizes = options["size"] if "size" in options else args[0] if len(args) == 1 else args
        return self._randn(
            tuple(sizes), {place: options.get(place) for place in ("device", "dtype")}
        )

    def _randn(self, shape: tuple[int, ...], place: dict[str, Any]) -> Any:
        each = shape[0] // len(self._generators)
        rows = [
            torch.randn(each, *shape[1:], generator=generator) for generator in self._generators
        ]
        return torch.cat(rows).to(**place, non_blocking=True)

    def _multinomial(self, weights: Any, num_samples: int) -> Any:
        blocks = weights.float().cpu().chunk(len(self._generators))
        each = zip(blocks, self._generators, strict=True)
        drawn = [
            torch.multinomial(block, num_samples, generator=generator) for block, generator in each
        ]
        return torch.cat(drawn).to(weights.device, non_blocking=True)


class RowNoise(RowDraws):
    """`RowDraws` of the numbers of `Row.noise`, with a row of each batch for each of `rows`."""

    def __init__(self, rows: Sequence[Row], ahead: int, *models: Any) -> None:
        """Prepare to draw for rows; the first `ahead` draws have one shape, and are made and
        copied together.
        """
        super().__init__([row.rng for row in rows], *models)
        self._rows, self._ahead, self._left = rows, ahead, list[Any]()

    def _randn(self, shape: tuple[int, ...], place: dict[str, Any]) -> Any:
        if len(shape) < 2 or shape[0] != len(self._rows):
            raise PolicyFailed(
                f"the model asked for noise {shape}, want one row for each of {len(self._rows)}"
            )
        if not self._left:
            drawn = torch.from_numpy(
                np.stack([row.noise(self._ahead, *shape[1:]) for row in self._rows], 1)
            )
            self._left, self._ahead = list(drawn.to(**place, non_blocking=True)), 1
        return self._left.pop(0)


def _draw(name: str, *args: Any, **options: Any) -> Any:
    draws = _DRAWS.get()
    return (
        getattr(torch, name)(*args, **options)
        if draws is None
        else draws.draw(name, *args, **options)
    )


# Stands for `torch` in modules that draw. Other attributes are torch's own, found without a call of
# Python.
_TORCH = ModuleType("torch")
vars(_TORCH).update(vars(torch), __getattr__=partial(getattr, torch))
for _name in ("randn", "multinomial", "rand", "randint", "randn_like", "rand_like", "normal"):
    setattr(_TORCH, _name, partial(_draw, _name))
