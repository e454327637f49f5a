"""CUDA graphs: their results and the memory of these, new weights, and other threads."""

from __future__ import annotations

import threading
from typing import Any

import pytest
import torch

from vlagents_ray.policies.compilation import Compilation, CudaGraph
from vlagents_ray.weights.trainable import named_values, set_values

pytestmark = [pytest.mark.torch, pytest.mark.gpu]

ROWS, DIM = 3, 5


@pytest.fixture
def layer() -> Any:
    torch.manual_seed(0)
    return torch.nn.Linear(DIM, DIM, device="cuda").requires_grad_(False)


def numbers() -> Any:
    return torch.randn(ROWS, DIM, device="cuda")


def test_each_call_computes_with_its_own_inputs_and_returns_memory_of_its_own(layer: Any) -> None:
    graph = CudaGraph(lambda x, y: (layer(x), x * y), [numbers(), numbers()])
    inputs = [(numbers(), numbers()) for _ in range(3)]
    results = [graph(x, y) for x, y in inputs]
    for (x, y), (first, second) in zip(inputs, results, strict=True):
        torch.testing.assert_close(first, layer(x))
        torch.testing.assert_close(second, x * y)


def test_new_weights_act_in_a_captured_graph(layer: Any) -> None:
    graph, x = CudaGraph(layer, [numbers()]), numbers()
    set_values(layer, {name: value + 1 for name, value in named_values(layer).items()})
    torch.testing.assert_close(graph(x), layer(x))


def test_a_core_is_captured_on_one_thread_and_acts_on_another(layer: Any) -> None:
    compilation, results = Compilation("require"), list[Any]()
    with torch.inference_mode():
        core = compilation.core("layer", lambda x: layer(x).relu())
        for size in (ROWS, 1):
            compilation.add_size(size, lambda size=size: core(numbers()[:size]))  # type: ignore[misc]
        assert compilation.sizes == [1, ROWS]
        inputs = [numbers()[:size] for size in (1, 2, ROWS)]

        def act() -> None:
            with torch.inference_mode():
                results.extend(core(x) for x in inputs)

        thread = threading.Thread(target=act)
        thread.start()
        thread.join()
        for x, result in zip(inputs, results, strict=True):
            torch.testing.assert_close(result, layer(x).relu())


@pytest.mark.parametrize("mode", ["graphs", True])
def test_cores_of_one_policy_share_memory_and_keep_their_results(layer: Any, mode: Any) -> None:
    compilation = Compilation(mode)

    def shifted(x: Any) -> Any:
        return layer(x) + torch.tensor([1.0] + [0.0] * (DIM - 1), device=x.device)

    with torch.inference_mode():
        step = compilation.core("step", shifted)
        both = compilation.core("both", lambda x: step(step(x)), parts=[step])
        for size in (ROWS, 1):
            compilation.add_size(size, lambda size=size: both(numbers()[:size]))  # type: ignore[misc]
        assert compilation.sizes == [1, ROWS]
        assert compilation.graph_bytes >= 0
        inputs = [numbers()[:size] for size in (1, 2, ROWS)]
        results = [(step(x), both(x)) for x in inputs]
        for x, (once, twice) in zip(inputs, results, strict=True):
            torch.testing.assert_close(once, shifted(x))
            torch.testing.assert_close(twice, shifted(shifted(x)))
