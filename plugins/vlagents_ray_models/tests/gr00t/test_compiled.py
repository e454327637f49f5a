"""The transformer of GR00T's action head as a core, with a stand-in for NVIDIA's class."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from counting_compiler import CountingCompiler, counting_compiler

from vlagents_ray.policies.compilation import Compilation
from vlagents_ray_models.gr00t import compile_with

pytestmark = pytest.mark.torch

DIM, SPARE = 4, 3


class Transformer(torch.nn.Module):
    """Attends to the tokens of each mask in turn, like NVIDIA's `AlternateVLDiT`, or to all,
    like its `DiT`.
    """

    def forward(
        self,
        hidden_states: Any,
        encoder_hidden_states: Any,
        timestep: Any = None,
        image_mask: Any = None,
        backbone_attention_mask: Any = None,
        kv_cache: Any = None,
    ) -> Any:
        attention = torch.nn.functional.scaled_dot_product_attention
        masks = (
            [None]
            if image_mask is None
            else [image_mask & backbone_attention_mask, backbone_attention_mask]
        )
        hidden = hidden_states + timestep[:, None, None]
        context = encoder_hidden_states
        for mask in masks:
            allowed = None if mask is None else mask[:, None].expand(-1, hidden.shape[1], -1)
            hidden = attention(hidden, context, context, attn_mask=allowed)
        return hidden


@pytest.fixture
def compiler() -> Iterator[CountingCompiler]:
    with counting_compiler() as compiler:
        yield compiler


def inputs(rows: int, tokens: int, *, masked: bool) -> dict[str, Any]:
    arguments = {
        "hidden_states": torch.randn(rows, 2, DIM),
        "encoder_hidden_states": torch.randn(rows, tokens, DIM),
        "timestep": torch.full((rows,), 500),
    }
    if masked:
        positions = torch.arange(tokens).expand(rows, -1)
        arguments["image_mask"] = positions < 2
        arguments["backbone_attention_mask"] = positions < tokens - 1
    return arguments


@pytest.mark.parametrize("masked", [True, False])
def test_prompts_of_other_lengths_use_the_same_program_if_padding_is_masked(
    compiler: CountingCompiler, masked: bool
) -> None:
    plain, transformer, compilation = Transformer(), Transformer(), Compilation("require")
    compile_with(transformer, SPARE, compilation)
    with torch.inference_mode():
        compilation.add_size(2, lambda: transformer(**inputs(2, 5, masked=masked)))
        for rows, tokens in ((2, 5), (1, 5), (2, 8), (1, 6), (2, 9), (3, 5)):
            calls, arguments = compiler.calls, inputs(rows, tokens, masked=masked)
            torch.testing.assert_close(transformer(**arguments, kv_cache={}), plain(**arguments))
            fits = rows <= 2 and tokens <= (5 + SPARE if masked else 5)
            assert compiler.calls == calls + (fits and (masked or tokens == 5))
    assert compiler.rows == [2]


def test_without_compilation_it_is_called_with_all_arguments() -> None:
    transformer, compilation = Transformer(), Compilation("auto")
    arguments = inputs(2, 5, masked=True)
    expected = transformer(**arguments)
    caches: list[Any] = []
    forward = transformer.forward

    def noting_cache(*args: Any, **options: Any) -> Any:
        caches.append(options["kv_cache"])
        return forward(*args, **options)

    transformer.forward = noting_cache
    compile_with(transformer, SPARE, compilation)
    compilation.mode = False
    cache: dict[str, Any] = {}
    torch.testing.assert_close(transformer(**arguments, kv_cache=cache), expected)
    assert caches[0] is cache
