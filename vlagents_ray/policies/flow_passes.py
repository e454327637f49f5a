"""Flow matching of torch models in two passes: what a robot sees, encoded once, and the velocity of the flow.

The passes are functions of tensors, so that they can be compiled. The keys and values of all layers are one tensor,
`encoded`, (P, layers, 2, …) of P observations.
"""

from __future__ import annotations

import abc
import sys
from collections.abc import Sequence
from typing import Any

from vlagents_ray.policies.adapters import Adapters
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import Change, follow
from vlagents_ray.registry import require


class FlowPasses(abc.ABC):
    """The passes of a model."""

    def __init__(self, model: Any, compilation: Compilation) -> None:
        """Use the passes of a model of openpi, or of LeRobot, in their compiled form if there is one."""
        self.model = model
        self.adapters = Adapters()  # of the policy
        self.module = sys.modules[type(model).__module__]  # with the functions of its authors' own passes
        self.attention_mask = self.module.make_att_2d_masks
        self._encode = compilation.core("encode", self.encode)
        self._velocity = compilation.core("velocity", self.velocity)

    def encode_images(self, images: Sequence[Any]) -> Sequence[Any]:
        """Return what `encode` gets of images (P, 3, H, W)."""
        return images

    @abc.abstractmethod
    def encode(self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any) -> tuple[Any, Any]:
        """Return keys and values, and which of the tokens (P, L) are there, 1 or 0.

        Args:
            tokens: Of the instruction, (P, T) int64.
            mask: (P, T) bool, which of them are no padding.
            cameras: (P, N) bool, which of the images are there.
            state: (P, S).
            images: What `encode_images` returned for the N images.
        """

    @abc.abstractmethod
    def velocity(self, encoded: Any, seen: Any, state: Any, actions: Any, times: Any) -> Any:
        """Return the velocity (B, H, D) of noisy actions (B, H, D) at times (B,)."""

    def sample(
        self,
        images: Sequence[Any],
        cameras: Sequence[Any],
        tokens: Any,
        mask: Any,
        state: Any = None,
        *,
        noise: Any,
        owners: Sequence[int],
        steps: int,
        changes: Sequence[Change] = (),
        fingerprints: Sequence[str] = (),
    ) -> Any:
        """Return actions (B, H, D).

        Args:
            images: Of P observations, (P, 3, H, W) for each of N cameras.
            cameras: Which of them are there, (P,) bool for each camera.
            tokens: See `encode`.
            mask: See `encode`.
            state: See `encode`; None for a model that has it in its prompt.
            noise: (B, H, D).
            owners: The observation of each row.
            steps: Of the flow.
            changes: See `follow`.
            fingerprints: The adapter of each row, see `Row.adapter`; empty: none has one.
        """
        torch = require("torch")
        firsts = [list(owners).index(place) for place in range(len(mask))] if fingerprints else []
        if state is None:
            state = mask[:, :0].float()
        with self.adapters.rows([fingerprints[i] for i in firsts]):
            encoded, seen = self._encode(
                tokens, mask, torch.stack(list(cameras), 1), state, *self.encode_images(images)
            )
        if list(owners) != list(range(len(mask))):
            index = torch.tensor(owners, device=mask.device)
            encoded, seen, state = encoded[index], seen[index], state[index]

        def velocity(actions: Any, time: float) -> Any:
            times = torch.full((len(actions),), time, dtype=torch.float32, device=actions.device)
            with self.adapters.rows(fingerprints):
                return self._velocity(encoded, seen, state, actions, times)

        return follow(velocity, noise, steps, *changes)


class Pi0Passes(FlowPasses):
    """The passes of openpi's PyTorch port of π0 and π0.5, which LeRobot has copied."""

    def __init__(self, model: Any, compilation: Compilation, *, stated: bool = True) -> None:
        """Use the passes of a `PI0Pytorch` or `PI05Pytorch`.

        Args:
            model: The model.
            compilation: That of the policy.
            stated: Whether the model's `denoise_step` takes the state, which that of LeRobot's π0.5 does not.
        """
        self._stated = stated
        model.paligemma_with_expert.paligemma.model.language_model.config._attn_implementation = "eager"
        super().__init__(model, compilation)
        own = getattr(model, "_prepare_attention_masks_4d", None)  # a function in newer versions of LeRobot
        self._mask_4d = own or self.module.prepare_attention_masks_4d

    def encode(self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any) -> tuple[Any, Any]:
        """Return keys and values, and which tokens are there; the state is not read."""
        import torch  # the compiler follows a statement, and not `require`

        embedded, seen, causal = self.model.embed_prefix(list(images), list(cameras.unbind(1)), tokens, mask)
        _, cache = self.model.paligemma_with_expert.forward(
            attention_mask=self._mask_4d(self.attention_mask(seen, causal)),
            position_ids=seen.cumsum(1) - 1,
            inputs_embeds=[embedded, None],
            use_cache=True,
        )
        return torch.stack([torch.stack(layer, 1) for layer in layers_of(cache)], 1), seen.long()

    def velocity(self, encoded: Any, seen: Any, state: Any, actions: Any, times: Any) -> Any:
        """Return the velocity (B, H, D)."""
        cache = cache_of(encoded.unbind(1))  # of this step alone
        stated = {"state": state} if self._stated else {}
        return self.model.denoise_step(
            prefix_pad_masks=seen.bool(), past_key_values=cache, x_t=actions, timestep=times, **stated
        )


def layers_of(cache: Any) -> list[tuple[Any, Any]]:
    """Return keys and values of each layer of a transformers `DynamicCache`; its versions differ in where they are."""
    if hasattr(cache, "layers"):
        return [(layer.keys, layer.values) for layer in cache.layers]
    return [cache[number] for number in range(len(cache))]


def cache_of(layers: Sequence[Any]) -> Any:
    """Return a transformers `DynamicCache` with these keys and values, (B, 2, …) for each layer."""
    from transformers import DynamicCache  # the compiler follows a statement, and not `require`

    cache = DynamicCache()
    for number, layer in enumerate(layers):
        cache.update(layer[:, 0], layer[:, 1], number)
    return cache
