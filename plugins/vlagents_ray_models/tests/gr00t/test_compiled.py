"""The transformer of GR00T's action head as a core, with a stand-in of NVIDIA's class."""

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
        seen = hidden_states + timestep[:, None, None]
        for mask in masks:
            allowed = None if mask is None else mask[:, None].expand(-1, seen.shape[1], -1)
            seen = attention(seen, encoder_hidden_states, encoder_hidden_states, attn_mask=allowed)
        return seen


@pytest.fixture
def compiler() -> Iterator[CountingCompiler]:
    with counting_compiler() as compiler:
        yield compiler


def inputs(rows: int, tokens: int, *, masked: bool) -> dict[str, Any]:
    found = {
        "hidden_states": torch.randn(rows, 2, DIM),
        "encoder_hidden_states": torch.randn(rows, tokens, DIM),
        "timestep": torch.full((rows,), 500),
    }
    if masked:
        there = torch.arange(tokens).expand(rows, -1) < tokens - 1
        found |= {
            "image_mask": torch.arange(tokens).expand(rows, -1) < 2,
            "backbone_attention_mask": there,
        }
    return found


@pytest.mark.parametrize("masked", [True, False])
def test_prompts_of_other_lengths_use_the_same_program_if_padding_is_masked(
    compiler: CountingCompiler, masked: bool
) -> None:
    plain, transformer, compilation = Transformer(), Transformer(), Compilation("require")
    compile_with(transformer, SPARE, compilation)
    with torch.inference_mode():
        compilation.add_size(2, lambda: transformer(**inputs(2, 5, masked=masked)))
        for rows, tokens in ((2, 5), (1, 5), (2, 8), (1, 6), (2, 9), (3, 5)):
            calls, given = compiler.calls, inputs(rows, tokens, masked=masked)
            torch.testing.assert_close(transformer(**given, kv_cache={}), plain(**given))
            fits = rows <= 2 and tokens <= (5 + SPARE if masked else 5)
            assert compiler.calls == calls + (fits and (masked or tokens == 5))
    assert compiler.rows == [2]


def test_without_compilation_it_is_called_as_ever() -> None:
    transformer, kept, compilation = Transformer(), {}, Compilation("auto")
    given = inputs(2, 5, masked=True)
    wanted = transformer(**given)
    seen: list[Any] = []
    forward = transformer.forward
    transformer.forward = lambda *args, **named: (
        seen.append(named["kv_cache"]) or forward(*args, **named)
    )
    compile_with(transformer, SPARE, compilation)
    compilation.mode = False
    torch.testing.assert_close(transformer(**given, kv_cache=kept), wanted)
    assert seen[0] is kept
