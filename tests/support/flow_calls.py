"""The torch calls in an act of π0 or π0.5 with the published size, counted on the device meta."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch_calls import META, TorchCalls

ROWS, CAMERAS, STEPS = 2, 3, 10
SIDE = 224  # px
STATE = 32  # length of a state and of an action


@dataclass(frozen=True)
class FlowCalls:
    """The number of calls of an act, or of its kernel launches."""

    prefix: int
    once: int  # calls that are made once for all steps, or that depend only on the steps' times
    step: int

    @property
    def chunk(self) -> int:
        """The number of calls of a chunk with `STEPS` steps."""
        return self.prefix + self.once + STEPS * self.step


def calls_of_flow(passes: Any, *, words: int, horizon: int, dtype: Any) -> dict[str, FlowCalls]:
    """Count the calls of an act with three cameras.

    Args:
        passes: The `Pi0HfPasses` or `Pi0Passes` of a network on the device meta.
        words: The number of tokens of an instruction; for a `Pi0HfPasses`, including those of
            images.
        horizon: The number of rows of a chunk.
        dtype: The type of states and images.

    Returns:
        "calls", the number of ATen calls, and "launches", in which a function with its own CUDA
        kernel counts once.
    """

    def empty(*shape: int, dtype: Any = dtype) -> Any:
        return torch.zeros(*shape, dtype=dtype, device=META)

    tokens = empty(ROWS, words, dtype=torch.int64)
    cameras = empty(ROWS, CAMERAS, dtype=torch.bool)
    state = empty(ROWS, STATE)
    actions = empty(ROWS, horizon, STATE, dtype=torch.float32)
    times = empty(ROWS, STEPS, dtype=torch.float32)
    if hasattr(passes, "use_attention"):
        mask = empty(ROWS, words, dtype=torch.bool)
        images = [empty(ROWS, 3, SIDE, SIDE) for _ in range(CAMERAS)]
    else:
        mask, images = tokens, [empty(ROWS, CAMERAS, 3, SIDE, SIDE)]

    with torch.inference_mode():
        with TorchCalls() as prefix:
            encoded, present = passes.encode(tokens, mask, cameras, state, *images)
        with TorchCalls() as once:
            constants = passes.constants(encoded, present, state, horizon)
            at_times = passes.at_times(times)
        with TorchCalls() as step:
            passes.velocity(constants, actions, at_times[:, 0])
    assert not step.waits

    counts = {}
    for name in ("calls", "launches"):
        counts[name] = FlowCalls(*(getattr(part, name) for part in (prefix, once, step)))
        print(f"{type(passes).__name__}, {name}: {counts[name]}, a chunk {counts[name].chunk}")
    return counts
