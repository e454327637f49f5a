"""Session-specific random numbers for models that draw from torch's global generator."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
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
# The draws of this thread's forward pass.
_DRAWS: ContextVar[RowDraws | None] = ContextVar("draws", default=None)


def generator_of(rng: np.random.Generator) -> Any:
    """Make a torch generator that is seeded from `rng`.

    The generator is on the CPU, so that draws are the same on every device.
    """
    return torch.Generator().manual_seed(int(rng.integers(_SEEDS)))


@contextlib.contextmanager
def seeded(rng: np.random.Generator, device: Any) -> Iterator[None]:
    """Seed torch's global generators from `rng` within the context, and restore their state
    afterwards.
    """
    devices = [device] if device.type == "cuda" else []
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(int(rng.integers(_SEEDS)))
        yield


class RowDraws:
    """A context in which a model's code draws each row of a batch from that row's generator.

    Only the modules that define the model's own class draw in this way, with `torch.randn` and
    `torch.multinomial`; any other draw in these modules is an error. Layers and other threads are
    not affected. torch's function modes would affect them, and would also make each call of torch
    take half as long again. The batch must be the first dimension of every draw, or the outer part
    of that dimension.
    """

    def __init__(self, rngs: Sequence[np.random.Generator], *models: Any) -> None:
        """Replace `torch` in the modules of models, so that they can draw for rows.

        Args:
            rngs: The generator of each row.
            models: Modules, or objects, which stand for the modules of their classes.
        """
        self._rngs = rngs
        self._has_drawn = False
        for model in models:
            for module in _modules_of(model):
                uses_torch = getattr(module, "torch", None) is torch
                if uses_torch and not module.__name__.startswith("torch."):
                    module.torch = _TORCH

    def __enter__(self) -> Self:
        self._token: Token[RowDraws | None] = _DRAWS.set(self)
        return self

    def __exit__(self, error: object, *_: object) -> None:
        _DRAWS.reset(self._token)
        if error is None and not self._has_drawn:
            raise PolicyFailed(
                "the model drew no numbers for its rows; is its code of the version that is "
                "required?"
            )

    @cached_property
    def _generators(self) -> list[Any]:
        return [generator_of(rng) for rng in self._rngs]

    def draw(self, name: str, *args: Any, **options: Any) -> Any:
        """Draw as the function `name` of torch does.

        Args:
            name: The name of a function that draws.
            args: Its arguments.
            options: Its arguments by name.

        Raises:
            PolicyFailed: The function cannot draw for each row.
        """
        self._has_drawn = True
        if name == "multinomial":
            return self._multinomial(*args, **options)
        if name != "randn":
            raise PolicyFailed(
                f"the model drew from {name}: its actions would depend on its neighbours'"
            )
        if "size" in options:
            shape = options["size"]
        elif len(args) == 1:
            [shape] = args
        else:
            shape = args
        return self._randn(tuple(shape), options.get("device"), options.get("dtype"))

    def _randn(self, shape: tuple[int, ...], device: Any, dtype: Any) -> Any:
        """Draw standard normal numbers. Each row has the same number of entries."""
        entries = shape[0] // len(self._generators)
        drawn = [
            torch.randn(entries, *shape[1:], generator=generator) for generator in self._generators
        ]
        return torch.cat(drawn).to(device=device, dtype=dtype, non_blocking=True)

    def _multinomial(self, weights: Any, num_samples: int) -> Any:
        """Draw indices with these weights. Each row has the same number of entries."""
        blocks = weights.float().cpu().chunk(len(self._generators))
        drawn = []
        for block, generator in zip(blocks, self._generators, strict=True):
            drawn.append(torch.multinomial(block, num_samples, generator=generator))
        return torch.cat(drawn).to(weights.device, non_blocking=True)


def _modules_of(model: Any) -> list[Any]:
    """Return the modules that define the class of an object and the base classes.

    For a module, return the module itself.
    """
    if isinstance(model, ModuleType):
        return [model]
    return [sys.modules.get(base.__module__) for base in type(model).__mro__]


class RowNoise(RowDraws):
    """A `RowDraws` that uses the numbers of `Row.noise`. Every batch has one entry for each row."""

    def __init__(self, rows: Sequence[Row], ahead: int, *models: Any) -> None:
        """Replace `torch` in the modules of models, so that they can draw for rows.

        Args:
            rows: The rows.
            ahead: The number of first draws that have the same shape. They are made and copied
                together.
            models: As for `RowDraws`.
        """
        super().__init__([row.rng for row in rows], *models)
        self._rows = rows
        self._ahead = ahead
        self._prepared: list[Any] = []  # prepared results of the next draws

    def _randn(self, shape: tuple[int, ...], device: Any, dtype: Any) -> Any:
        if len(shape) < 2 or shape[0] != len(self._rows):
            raise PolicyFailed(
                f"expected noise of one row for each of {len(self._rows)}, got {shape} from the "
                "model"
            )
        if not self._prepared:
            noise = np.stack([row.noise(self._ahead, *shape[1:]) for row in self._rows], 1)
            drawn = torch.from_numpy(noise).to(device=device, dtype=dtype, non_blocking=True)
            self._prepared = list(drawn)
            self._ahead = 1
        return self._prepared.pop(0)


def _draw(name: str, *args: Any, **options: Any) -> Any:
    """Call the function `name` of torch, or draw for the rows of this thread's pass."""
    draws = _DRAWS.get()
    if draws is None:
        return getattr(torch, name)(*args, **options)
    return draws.draw(name, *args, **options)


# Replaces `torch` in modules that draw. All other attributes are torch's own. They are copied, so
# that reading them calls no Python function.
_TORCH = ModuleType("torch")
vars(_TORCH).update(vars(torch), __getattr__=partial(getattr, torch))
for _name in ("randn", "multinomial", "rand", "randint", "randn_like", "rand_like", "normal"):
    setattr(_TORCH, _name, partial(_draw, _name))
