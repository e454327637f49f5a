"""The layers of a Gemma model, with keys and values as tensors.

The forward passes of transformers and of openpi build masks, position embeddings and a cache in
each call. These are the same in each step of a flow: `Pi0HfPasses` and `Pi0Passes` compute them
once, and call the layers with them. The functions support the layers of transformers' `GemmaModel`,
and the layers of openpi and LeRobot, which add conditions and gates to the norms. A norm multiplies
by `1 + weight`, and an adaptive norm by a factor that it computes from a condition. These factors
are the norm's *modulation*, an argument of the layers here. The modulation of all norms is computed
together, once for each flow. It is not kept between flows, so that pushed weights take effect
without a further step.

Attention is torch's own (`scaled_dot_product_attention`). Masks are added to the attention scores,
since torch's kernels would convert a boolean mask in each call. With `flex_attention`, torch makes
a kernel for the masks, which also divides the keys of a few queries among the processors of a GPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

from vlagents_ray.policies.compilation import Compilation

Attention = Literal["sdpa", "flex"]

# Torch's kernels copy a mask in each call, unless its rows begin at multiples of this number.
_ALIGNED = 8
# The attribute of an attention or an MLP module that contains the weights of several of its linear
# layers as one tensor.
_MERGED = "merged_weight"


class GemmaLayers:
    """The forward passes of a `GemmaModel` over a prefix, and over the tokens of each step of a
    flow.
    """

    def __init__(self, model: Any, compilation: Compilation, attention: Attention = "sdpa") -> None:
        """Use the layers of a model, each of which becomes a region of the compiled cores.

        Args:
            model: The `GemmaModel`.
            compilation: Compiles the cores.
            attention: The attention kernel of compiled steps.
        """
        self.model = model
        self.attention: Attention = attention
        self._layer = compilation.region(gemma_layer)
        self._norm = compilation.region(_normed)

    def merge_products(self) -> None:
        """Let each layer compute queries, keys and values in one product, and `gate_proj` and
        `up_proj` in one product.

        The parameters become views of one tensor for each product, with the names, shapes and
        values that they had. Pushed weights on a GPU are copied into the memory of the parameters,
        and therefore also change the merged tensor. On a CPU, pushed weights replace the
        parameters, so no weights may be pushed after this call. Layers must not be quantized.
        """
        for layer in self.model.layers:
            attention, mlp = layer.self_attn, layer.mlp
            _merge(attention, [attention.q_proj, attention.k_proj, attention.v_proj])
            _merge(mlp, [mlp.gate_proj, mlp.up_proj])

    @property
    def is_adaptive(self) -> bool:
        """Whether the norms of the model have a condition."""
        return getattr(self.model.norm, "dense", None) is not None

    def scales(self, rows: int) -> Any:
        """Return the modulation of norms without a condition, for `step`.

        Args:
            rows: The number of rows, B.

        Returns:
            (B, norms, 1, 1, D) float32, the same for all rows.
        """
        scales = _scales(self._norms())
        return scales[:, None, None].expand(rows, *scales.shape[:1], 1, 1, -1)

    def modulation(self, condition: Any) -> Any:
        """Return the modulation of adaptive norms, for `step`.

        Args:
            condition: (B, C), or (B, S, C) with a condition for each token.

        Returns:
            The factor, summand and gate of each norm, (B, norms, 3, 1 or S, D) float32.
        """
        import torch

        values = torch.stack([norm.dense(condition) for norm in self._norms()], 1).float()
        if condition.ndim == 2:
            values = values.unsqueeze(2)
        scale, summand, gate = values.chunk(3, -1)
        return torch.stack([1 + scale, summand, gate], 2)

    def _norms(self) -> list[Any]:
        """Return the norms of a step, in the order of its modulation."""
        norms = []
        for layer in self.model.layers:
            norms += [layer.input_layernorm, layer.post_attention_layernorm]
        return [*norms, self.model.norm]

    def encode(self, embedded: Any, present: Any) -> Any:
        """Return keys and values of a prefix, (P, layers, 2, heads, L, E).

        Args:
            embedded: The embeddings of the prefix tokens, (P, L, D).
            present: Whether each token is no padding, (P, L).
        """
        import torch  # torch's compiler follows this statement, but not `require`

        hidden = self._in_type_of_weights(embedded)
        # All tokens attend to the tokens that are present.
        mask = _additive_mask(present.bool()[:, None, None], hidden.dtype)
        rotation = self._rotation(hidden, present.long().cumsum(-1) - 1)

        *layers, last_layer = self.model.layers
        scales = _scales(self._norms())
        keys_and_values = []
        for number, layer in enumerate(layers):
            of_layer = scales[2 * number : 2 * number + 2]
            hidden, keys, values = self._layer(layer, hidden, mask, rotation, of_layer)
            keys_and_values.append(torch.stack([keys, values], 1))
        # Only the keys and values of the last layer are needed.
        normed = _normed(last_layer.input_layernorm, hidden, scales[2 * len(layers)])
        _, keys, values = _heads(last_layer.self_attn, normed, rotation)
        keys_and_values.append(torch.stack([keys, values], 1))
        return torch.stack(keys_and_values, 1)

    def constants(
        self, encoded: Any, present: Any, tokens: int, *, has_state: bool
    ) -> tuple[Any, Any, Any]:
        """Compute the inputs from the prefix that all steps of a flow share.

        Args:
            encoded: The result of `encode` of another `GemmaModel` with the same heads, for the B
                rows.
            present: Whether each token of the prefix is no padding, (B, L).
            tokens: The number of tokens of a step, S.
            has_state: Whether the first token is the token of the state, which does not attend to
                the other tokens of the step.

        Returns:
            The first three arguments of `step`.
        """
        import torch

        rows, length = present.shape
        shape = (rows, 1, tokens, length + tokens)
        is_visible = torch.ones(shape, dtype=torch.bool, device=present.device)
        is_visible[..., :length] = present.bool()[:, None, None]
        if has_state:
            is_visible[:, :, 0, length + 1 :] = False

        numbers = torch.arange(tokens, device=present.device)
        positions = present.long().sum(-1, keepdim=True) + numbers
        rotation = self._rotation(encoded, positions)
        return encoded, _additive_mask(is_visible, encoded.dtype), rotation

    def step(self, encoded: Any, mask: Any, rotation: Any, modulation: Any, embedded: Any) -> Any:
        """Return the last hidden states of the tokens of a step, (B, S, D).

        Args:
            encoded: Keys and values of the prefix, (B, layers, 2, heads, L, E).
            mask: (B, 1, S, L').
            rotation: (B, 2, S, E).
            modulation: The result of `scales`, or of `modulation`.
            embedded: The embeddings of the tokens, (B, S, D).
        """
        hidden = self._in_type_of_weights(embedded)
        gates = None
        if self.is_adaptive:
            by_norm = modulation.transpose(0, 1)  # (norms, B, 3, 1 or S, D)
            factors, gates = by_norm[:, :, :2], by_norm[:, :, 2].to(hidden.dtype)
        else:
            factors = modulation[0, :, 0, 0]  # (norms, D)

        for number, layer in enumerate(self.model.layers):
            of_layer = slice(2 * number, 2 * number + 2)
            hidden, _, _ = self._layer(
                layer,
                hidden,
                mask,
                rotation,
                factors[of_layer],
                encoded[:, number],
                None if gates is None else gates[of_layer],
                self.attention == "flex",
            )
        return self._norm(self.model.norm, hidden, factors[-1])

    def _in_type_of_weights(self, embedded: Any) -> Any:
        return embedded.to(self.model.layers[0].self_attn.q_proj.weight.dtype)

    def _rotation(self, like: Any, positions: Any) -> Any:
        """Return the rotation of queries and keys at positions (B, S), for `_rotated`.

        Args:
            like: A tensor of the type and on the device of the hidden states.
            positions: (B, S).

        Returns:
            Cosines and signed sines, (B, 2, S, E).
        """
        import torch

        cos, sin = self.model.rotary_emb(like, positions)
        half = sin.shape[-1] // 2
        signed_sin = torch.cat([-sin[..., :half], sin[..., half:]], -1)
        return torch.stack([cos, signed_sin], 1)


def gemma_layer(
    layer: Any,
    hidden: Any,
    mask: Any,
    rotation: Any,
    factors: Any,
    prefix: Any = None,
    gates: Any = None,
    uses_flex: bool = False,
) -> tuple[Any, Any, Any]:
    """Compute one layer.

    Args:
        layer: The decoder layer.
        hidden: Hidden states, (B, S, D).
        mask: It is added to the scores, (B, 1, 1 or S, L'); L' may exceed the number of keys.
        rotation: Cosines and signed sines of the positions, (B, 2, S, E).
        factors: The factors of both norms, see `_normed`: (2, D), or (2, B, 2, 1 or S, D) for
            adaptive norms.
        prefix: The keys and values of earlier tokens, to which these tokens also attend, (B, 2,
            heads, L, E), or None.
        gates: The gates of the branches that begin with adaptive norms, (2, B, 1 or S, D), or None.
        uses_flex: Whether a compiled layer computes attention with `flex_attention`. An eager layer
            never does, so that the comparison of the compiled layer with the eager one also
            compares the two attention kernels.

    Returns:
        The new hidden states, and the keys and values of these tokens, (B, heads, S, E) each.
    """
    import torch

    attention = layer.self_attn
    normed = _normed(layer.input_layernorm, hidden, factors[0])
    queries, keys, values = _heads(attention, normed, rotation)

    all_keys, all_values = keys, values
    if prefix is not None:
        all_keys = torch.cat([prefix[:, 0], keys], 2)
        all_values = torch.cat([prefix[:, 1], values], 2)
    attend = _flexibly_attended if uses_flex and torch.compiler.is_compiling() else _attended
    attended = attend(queries, all_keys, all_values, mask, attention.scaling)
    hidden = _added(hidden, attention.o_proj(attended), None if gates is None else gates[0])

    normed = _normed(layer.post_attention_layernorm, hidden, factors[1])
    result = _mlp_result(layer.mlp, normed)
    hidden = _added(hidden, result, None if gates is None else gates[1])
    return hidden, keys, values


def compile_vision_layers(model: Any, compilation: Compilation) -> None:
    """Make each layer of the SigLIP encoder of a `PaliGemmaModel` a region of the compiled
    cores.
    """
    tower = model.vision_tower
    layers = getattr(tower, "vision_model", tower).encoder.layers
    region = compilation.region(type(layers[0]).forward)
    for layer in layers:
        layer.forward = partial(region, layer)


def _additive_mask(is_visible: Any, dtype: Any) -> Any:
    """Return a mask that is added to attention scores.

    Args:
        is_visible: Whether each query attends to each key, (B, 1, 1 or S, keys).
        dtype: The type in which attention is computed.

    Returns:
        The mask, whose rows are padded to a multiple of `_ALIGNED`.
    """
    import torch

    keys = is_visible.shape[-1]
    width = -(-keys // _ALIGNED) * _ALIGNED
    mask = torch.zeros(*is_visible.shape[:-1], width, dtype=dtype, device=is_visible.device)
    mask[..., :keys].masked_fill_(~is_visible, torch.finfo(dtype).min)
    return mask


def _scales(norms: Sequence[Any]) -> Any:
    """Return the factors of norms, (norms, D) float32: their weights plus 1."""
    import torch

    return torch.stack([norm.weight for norm in norms]).float() + 1


def _normed(norm: Any, hidden: Any, factors: Any) -> Any:
    """Return normed hidden states, (B, S, D).

    They are computed in float32, as in the norms of transformers and openpi. Torch's kernel, which
    needs a weight of the same type, replaces six operations.

    Args:
        norm: The norm, of which only the epsilon is read.
        hidden: Hidden states, (B, S, D).
        factors: The factors, (D,) float32; or factor and summand of an adaptive norm,
            (B, 2, 1 or S, D) float32.
    """
    from torch import addcmul
    from torch.nn.functional import rms_norm

    width = hidden.shape[-1:]
    if factors.ndim == 1:
        normed = rms_norm(hidden.float(), width, factors, norm.eps)
    else:
        scaled = rms_norm(hidden.float(), width, None, norm.eps)
        normed = addcmul(factors[:, 1], scaled, factors[:, 0])
    return normed.to(hidden.dtype)


def _added(hidden: Any, change: Any, gate: Any) -> Any:
    """Return the sum of hidden states and the result of a branch."""
    return hidden + change if gate is None else hidden.addcmul(change, gate)


def _merge(owner: Any, linears: Sequence[Any]) -> None:
    """Merge the weights of linear layers without biases, and store them in an attribute of `owner`.

    Layers with biases stay unchanged.
    """
    import torch

    if any(linear.bias is not None for linear in linears):
        return
    with torch.no_grad():
        merged = torch.cat([linear.weight for linear in linears])
        views = merged.split([linear.out_features for linear in linears])
        for linear, view in zip(linears, views, strict=True):
            linear.weight.data = view
    setattr(owner, _MERGED, merged)


def _heads(attention: Any, normed: Any, rotation: Any) -> tuple[Any, Any, Any]:
    """Return queries, keys and values, (B, heads, S, E) each. Queries and keys are rotated."""
    from torch.nn.functional import linear

    by_head = (*normed.shape[:-1], -1, attention.head_dim)
    merged = getattr(attention, _MERGED, None)
    if merged is None:
        queries = attention.q_proj(normed).view(by_head).transpose(1, 2)
        keys = attention.k_proj(normed).view(by_head).transpose(1, 2)
        values = attention.v_proj(normed).view(by_head).transpose(1, 2)
        return _rotated(queries, rotation), _rotated(keys, rotation), values

    heads = linear(normed, merged).view(by_head).transpose(1, 2)
    key_heads = attention.k_proj.out_features // attention.head_dim
    query_heads = heads.shape[1] - 2 * key_heads
    rotated = _rotated(heads[:, :-key_heads], rotation)
    return rotated[:, :query_heads], rotated[:, query_heads:], heads[:, -key_heads:]


def _mlp_result(mlp: Any, normed: Any) -> Any:
    """Return the result of a layer's MLP, (B, S, D)."""
    from torch.nn.functional import linear

    merged = getattr(mlp, _MERGED, None)
    if merged is None:
        return mlp(normed)
    gate, up = linear(normed, merged).chunk(2, -1)
    return mlp.down_proj(mlp.act_fn(gate) * up)


def _rotated(heads: Any, rotation: Any) -> Any:
    """Rotate queries or keys (B, heads, S, E) by their positions."""
    cos, signed_sin = rotation[:, :1], rotation[:, 1:]
    halves_exchanged = heads.roll(heads.shape[-1] // 2, -1)
    return (heads * cos).addcmul(halves_exchanged, signed_sin)


def _attended(queries: Any, keys: Any, values: Any, mask: Any, scaling: float) -> Any:
    """Return the result of attention, (B, S, heads * E)."""
    from torch.nn.functional import scaled_dot_product_attention

    count = queries.shape[1] // keys.shape[1]
    attended = scaled_dot_product_attention(
        queries,
        _shared_by(keys, count),
        _shared_by(values, count),
        attn_mask=mask[..., : keys.shape[2]],
        scale=scaling,
    )
    return attended.transpose(1, 2).flatten(2)


def _flexibly_attended(queries: Any, keys: Any, values: Any, mask: Any, scaling: float) -> Any:
    """Return the result of attention, (B, S, heads * E), computed with a kernel of
    `flex_attention`.
    """
    from torch.nn.attention.flex_attention import flex_attention

    def masked(score: Any, row: Any, _head: Any, query: Any, key: Any) -> Any:
        return score + mask[row, 0, query, key]

    attended = flex_attention(
        queries, keys, values, score_mod=masked, scale=scaling, enable_gqa=True
    )
    return attended.transpose(1, 2).flatten(2)


def _shared_by(heads: Any, count: int) -> Any:
    """Repeat each head of keys or values for `count` heads of queries.

    A single head becomes a view.
    """
    rows, kept, length, width = heads.shape
    return heads[:, :, None].expand(rows, kept, count, length, width).flatten(1, 2)
