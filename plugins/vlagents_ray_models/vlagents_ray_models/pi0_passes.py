"""The passes of openpi's PyTorch port of π0 and π0.5, which both openpi and LeRobot contain."""

from __future__ import annotations

from typing import Any

from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import FlowPasses
from vlagents_ray_models.key_value_cache import cache_of, layers_of, stack_of


class Pi0Passes(FlowPasses):
    """The passes of a `PI0Pytorch` or a `PI05Pytorch`."""

    def __init__(self, model: Any, compilation: Compilation, *, takes_state: bool = True) -> None:
        """Use the passes of a model, in their compiled form if there is one.

        Args:
            model: The `PI0Pytorch` or `PI05Pytorch`.
            compilation: Compiles the passes.
            takes_state: Whether the model's `denoise_step` has an argument for the state.
        """
        self._takes_state = takes_state
        language_model = model.paligemma_with_expert.paligemma.model.language_model
        language_model.config._attn_implementation = "eager"
        super().__init__(model, compilation)
        # A method in openpi, a function of the module in newer versions of LeRobot.
        method = getattr(model, "_prepare_attention_masks_4d", None)
        self._mask_4d = method or self.module.prepare_attention_masks_4d

    def encode(
        self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any
    ) -> tuple[Any, Any]:
        """Return keys and values, (P, layers, 2, heads, L, E), and the mask of the tokens, (P, L);
        the state is not read.
        """
        embedded, present, causal = self.model.embed_prefix(
            list(images), list(cameras.unbind(1)), tokens, mask
        )
        _, cache = self.model.paligemma_with_expert.forward(
            attention_mask=self._mask_4d(self.module.make_att_2d_masks(present, causal)),
            position_ids=present.cumsum(1) - 1,
            inputs_embeds=[embedded, None],
            use_cache=True,
        )
        return stack_of(layers_of(cache)), present.long()

    def velocity(self, encoded: Any, present: Any, state: Any, actions: Any, times: Any) -> Any:
        cache = cache_of(encoded.unbind(1))  # for this step only: the model appends to it
        state_argument = {"state": state} if self._takes_state else {}
        return self.model.denoise_step(
            prefix_pad_masks=present.bool(),
            past_key_values=cache,
            x_t=actions,
            timestep=times,
            **state_argument,
        )
