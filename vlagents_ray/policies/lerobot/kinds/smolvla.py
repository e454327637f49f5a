"""The passes of LeRobot's SmolVLA."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow_passes import FlowPasses, cache_of, layers_of
from vlagents_ray.registry import require


class SmolVLAPasses(FlowPasses):
    """The passes of SmolVLA, whose images are encoded from their patches."""

    def __init__(self, model: Any, compilation: Compilation) -> None:
        """Use the passes of a `VLAFlowMatching`, which takes patches in place of images from here on, too."""
        super().__init__(model, compilation)
        self._vlm = model.vlm_with_expert.get_vlm_model()
        # LeRobot 0.4 keeps keys and values by name, (B, L, heads, D), later ones in a cache of transformers.
        self._by_name = "fill_kv_cache" in inspect.signature(model.vlm_with_expert.forward).parameters
        self._positions: dict[tuple[int, int], Any] = {}  # of the patches of an image, (L,), by its height and width
        self._embed_image = model.vlm_with_expert.embed_image
        model.vlm_with_expert.embed_image = self._embed

    def look(self, images: Sequence[Any]) -> list[Any]:
        """Return the patches of images (P, 3, H, W) in the vision model's terms, (P, L, E).

        The vision model itself looks for the patches of each image of a batch, which could not be compiled.
        """
        vision = self._vlm.vision_model
        places = vision.embeddings.position_embedding
        found = []
        for image in images:
            patches = vision.embeddings.patch_embedding(image.to(vision.dtype)).flatten(2).transpose(1, 2)
            found.append(patches + places(self._positions_of(image)))
        return found

    def encode(self, tokens: Any, mask: Any, cameras: Any, state: Any, *patches: Any) -> tuple[Any, Any]:
        """Return keys and values, and which tokens are there."""
        import torch  # the compiler follows a statement, and not `require`

        embedded, seen, causal = self.model.embed_prefix(patches, cameras.unbind(1), tokens, mask, state=state)
        _, cache = self.model.vlm_with_expert.forward(
            attention_mask=self.attention_mask(seen, causal),
            position_ids=seen.cumsum(1) - 1,
            inputs_embeds=[embedded, None],
            use_cache=True,
            **({"fill_kv_cache": True} if self._by_name else {}),
        )
        if self._by_name:
            layers = [(layer["key_states"], layer["value_states"]) for layer in cache.values()]
        else:
            layers = layers_of(cache)
        return torch.stack([torch.stack(layer, 1) for layer in layers], 1), seen.long()

    def velocity(self, encoded: Any, seen: Any, state: Any, actions: Any, times: Any) -> Any:
        """Return the velocity (B, H, D)."""
        layers = encoded.unbind(1)
        if self._by_name:
            cache = {i: {"key_states": layer[:, 0], "value_states": layer[:, 1]} for i, layer in enumerate(layers)}
        else:
            cache = cache_of(layers)
        return self.model.denoise_step(prefix_pad_masks=seen.bool(), past_key_values=cache, x_t=actions, timestep=times)

    def _embed(self, patches: Any) -> Any:
        if patches.ndim == 4:  # an image, of LeRobot's own training pass
            return self._embed_image(patches)
        vision = self._vlm.vision_model
        hidden = vision.encoder(inputs_embeds=patches, attention_mask=None).last_hidden_state
        return self._vlm.connector(vision.post_layernorm(hidden))

    def _positions_of(self, image: Any) -> Any:
        """Return the positions that the vision model gives to the patches of an image of this size."""
        size = (image.shape[-2], image.shape[-1])
        if size not in self._positions:
            torch, vision = require("torch"), self._vlm.vision_model
            found: list[Any] = []
            hook = vision.embeddings.position_embedding.register_forward_pre_hook(lambda _, given: found.extend(given))
            with hook, self.adapters.rows(()):  # this image is of no row
                patches = [length // vision.patch_size for length in size]
                vision.embeddings(
                    image[:1].to(vision.dtype), torch.ones(1, *patches, dtype=torch.bool, device=image.device)
                )
            self._positions[size] = found[0][0].clone()
        return self._positions[size]
