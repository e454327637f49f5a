"""The number of operations of a push on a GPU. They share the GPU and the GIL with acts.

They are counted on the device "meta", with the shapes of π0: 3.5 billion parameters in 777 values.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from torch_calls import META, TorchCalls

from vlagents_ray.weights import trainable

pytestmark = pytest.mark.torch

VISION, VISION_MLP, VISION_LAYERS = 1152, 4304, 27
LANGUAGE, LANGUAGE_MLP = 2048, 16384
EXPERT, EXPERT_MLP = 1024, 4096
LAYERS, QUERIES, KEYS, VOCABULARY, ACTION = 18, 8 * 256, 256, 257_152, 32


def linear(outputs: int, inputs: int) -> list[tuple[int, ...]]:
    """Return the shapes of the weights and the bias of a layer."""
    return [(outputs, inputs), (outputs,)]


def shapes_of_pi0() -> Iterator[tuple[int, ...]]:
    """Yield the shape of each value of `PI0ForConditionalGeneration`."""
    for _ in range(VISION_LAYERS):
        yield from [(VISION,)] * 4  # two norms
        for _ in range(4):
            yield from linear(VISION, VISION)
        yield from linear(VISION_MLP, VISION)
        yield from linear(VISION, VISION_MLP)
    yield from [(VISION, 3, 14, 14), (VISION,), (256, VISION), (VISION,), (VISION,)]
    yield from linear(LANGUAGE, VISION)

    for width, mlp in ((LANGUAGE, LANGUAGE_MLP), (EXPERT, EXPERT_MLP)):
        for _ in range(LAYERS):
            yield from [(QUERIES, width), (KEYS, width), (KEYS, width), (width, QUERIES)]
            yield from [(mlp, width), (mlp, width), (width, mlp), (width,), (width,)]
        yield (width,)
    yield from [(VOCABULARY, LANGUAGE)] * 2

    for outputs, inputs in (
        (EXPERT, ACTION),
        (ACTION, EXPERT),
        (EXPERT, ACTION),
        (EXPERT, 2 * EXPERT),
        (EXPERT, EXPERT),
    ):
        yield from linear(outputs, inputs)


def values_of_pi0(dtype: torch.dtype = torch.bfloat16) -> dict[str, torch.Tensor]:
    values = {}
    for number, shape in enumerate(shapes_of_pi0()):
        values[str(number)] = torch.empty(shape, dtype=dtype, device=META)
    return values


@pytest.fixture(autouse=True)
def no_value_is_tied(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tell values apart by their names, since all addresses on the device "meta" are 0."""
    monkeypatch.setattr(trainable, "memory_of", lambda name, _: name)


def calls(counted: TorchCalls) -> tuple[int, int]:
    """Return the numbers of operations, and of waits of Python for the GPU."""
    return counted.calls, sum(counted.waits.values())


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
def test_a_push_of_pi0_from_the_same_gpu_takes_few_operations(dtype: torch.dtype) -> None:
    """In the second case, the learner's values have another type."""
    current, pushed = values_of_pi0(), values_of_pi0(dtype)
    assert len(current) == 777

    with TorchCalls() as checked:
        new = trainable.accepted(current, pushed)
    with TorchCalls() as merged:
        values = trainable.completed(current, new, allow_same=True, in_place=True)
    with TorchCalls() as digested:
        trainable.fingerprint(values)

    operations = [calls(counted)[0] for counted in (checked, merged, digested)]
    print(f"checks and copies, merge, digest: {operations} operations")
    assert sum(operations) <= 6000
    # Memory for each value, and a few operations for all of them.
    assert operations[0] <= len(current) + 20
    assert operations[1] == 0
    # Python waits only for the flags of finite values and the sums of the digest.
    assert [calls(counted)[1] for counted in (checked, digested)] == [1, 2]


def test_a_push_of_a_part_copies_the_rest_by_one_operation() -> None:
    current = values_of_pi0()
    with TorchCalls() as counted:
        trainable.completed(current, {"0": current["0"]}, allow_same=True, in_place=True)
    assert calls(counted) == (len(current) - 1 + 1, 0)
