"""The passes of transformers' π0: what it sees, encoded once, and the velocity of its flow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from vlagents_ray.registry import require


@dataclass(frozen=True)
class FlowCores:
    """The two passes of the network, which are functions of tensors: `encode` and `velocity_of`, or compiled forms."""

    encode: Callable[..., Any]
    velocity: Callable[..., Any]


def flow_velocity(
    network: Any,
    inputs: Mapping[str, Any],
    dtype: Any,
    owners: Sequence[int] | None = None,
    cores: FlowCores | None = None,
) -> Callable[[Any, float], Any]:
    """Return the flow's velocity as a function of noisy actions (B, H, D) and time; inputs are encoded once.

    Args:
        network: The `PI0ForConditionalGeneration`.
        inputs: Tokens, images and states of P observations, as `PI0Processor` returns them, on the network's device.
        dtype: The type in which the network computes.
        owners: The observation of each of the B rows; None: row i is of observation i.
        cores: The passes of the network, if they are compiled.

    Returns:
        The function, whose result is (B, H, D) float32.
    """
    torch = require("torch")
    cores = cores or FlowCores(partial(encode, network), partial(velocity_of, network))
    mask, state = inputs["attention_mask"], inputs["state"]
    encoded = cores.encode(inputs["input_ids"], inputs["pixel_values"], inputs["pixel_attention_mask"], mask)
    if owners is not None:
        index = torch.tensor(owners, device=mask.device)
        encoded, mask, state = encoded[index], mask[index], state[index]

    def velocity(actions: Any, time: float) -> Any:
        times = torch.full((len(actions),), time, dtype=torch.float32, device=actions.device)
        return cores.velocity(encoded, mask, state, actions.to(dtype), times)

    return velocity


def encode(network: Any, tokens: Any, images: Any, cameras: Any, mask: Any) -> Any:
    """Return the keys and values (P, layers, 2, heads, L, E) of tokens (P, L) and images, of which `mask` is not 0.

    Args:
        network: The `PI0ForConditionalGeneration`.
        tokens: (P, L) int64.
        images: (P, cameras, 3, S, S).
        cameras: (P, cameras) bool, which of the images are there.
        mask: (P, L), 0 for padding.
    """
    import torch  # the compiler follows a statement, and not `require`

    layers = network.model.vlm(
        inputs_embeds=network.model.embed_prefix(tokens, images, cameras),
        attention_mask=mask,
        position_ids=mask.cumsum(-1) - 1,
        token_type_ids=torch.zeros_like(mask),
        use_cache=True,
    ).past_key_values.layers
    return torch.stack([torch.stack([layer.keys, layer.values], 1) for layer in layers], 1)


def velocity_of(network: Any, encoded: Any, mask: Any, state: Any, actions: Any, times: Any) -> Any:
    """Return the velocity (B, H, D) float32 of noisy actions (B, H, D) at times (B,); see `encode` for the others."""
    from transformers import DynamicCache

    cache = DynamicCache()  # of this step alone: later ones must not attend to it
    for number, layer in enumerate(encoded.unbind(1)):
        cache.update(layer[:, 0], layer[:, 1], number)
    output = network(state=state, noise=actions, timestep=times, attention_mask=mask, past_key_values=cache)
    return output.logits.float()
