"""The noise of a batch, drawn for each row from its session's generator."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import PolicyFailed
from vlagents_ray.policies.base import Row
from vlagents_ray.registry import require


def noise_of(rows: Sequence[Row]) -> Any:
    """Return a context in which `torch.randn` draws each row, along the first axis, from its session's generator.

    The policies draw their first trajectory with it, and the scheduler the noise of each step; neither accepts one
    generator for each row. Other draws would come from the process's generator, and are refused.
    """
    return _mode()(rows)


@functools.cache
def _mode() -> type[Any]:
    """Return the class of that context, one for all: programs are compiled for the class of the context around them."""
    torch = require("torch")
    uniform = (torch.rand, torch.randint, torch.rand_like, torch.randn_like)

    class Noise(require("torch.overrides").TorchFunctionMode):  # type: ignore[misc]
        def __init__(self, rows: Sequence[Row]) -> None:
            super().__init__()
            self._rows = rows

        def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            options = kwargs or {}
            if func in uniform:
                raise PolicyFailed(f"the model drew from {func.__name__}: its actions would depend on its neighbours'")
            if func is not torch.randn:
                return func(*args, **options)
            shape, rows = options["size"] if "size" in options else args[0], self._rows
            if len(shape) < 2 or shape[0] != len(rows):
                raise PolicyFailed(f"the model asked for noise {tuple(shape)}, want one row for each of {len(rows)}")
            drawn = np.stack([row.noise(*shape[1:]) for row in rows])
            return torch.from_numpy(drawn).to(device=options.get("device"), dtype=options.get("dtype"))

    return Noise
