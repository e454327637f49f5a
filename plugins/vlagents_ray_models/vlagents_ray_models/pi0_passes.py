"""The forward passes of openpi's PyTorch port of π0 and π0.5, which openpi and LeRobot contain.

Once for each call of the policy, `encode` computes the keys and values of the prefix (images and
instruction), `constants` computes the mask and the positions with which the steps attend to the
prefix, and `at_times` computes the embeddings of the flow times and, for π0.5, the modulation of
the norms. In each step, `velocity` embeds the noisy actions and runs the layers of the action
expert.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import FlowPasses
from vlagents_ray_models.action_tokens import action_tokens
from vlagents_ray_models.gemma_layers import Attention, GemmaLayers, compile_vision_layers

# Shortest and longest period of the sines and cosines of a flow time in openpi. LeRobot has these
# values in its config.
_MIN_PERIOD, _MAX_PERIOD = 4e-3, 4.0


class Pi0Passes(FlowPasses):
    """The forward passes of a `PI0Pytorch` or a `PI05Pytorch`."""

    by_regions = True

    def __init__(self, model: Any, compilation: Compilation, *, takes_state: bool = True) -> None:
        """Use the forward passes of a model, whose `embed_prefix` then also accepts features of
        images.

        Args:
            model: The `PI0Pytorch` or `PI05Pytorch`.
            compilation: Compiles the passes.
            takes_state: Whether the model's `embed_suffix` has an argument for the state.
        """
        self._takes_state = takes_state
        self._has_state_token = hasattr(model, "state_proj")
        networks = model.paligemma_with_expert
        language_model = networks.paligemma.model.language_model
        self._language_model = GemmaLayers(language_model, compilation)
        self._expert = GemmaLayers(networks.gemma_expert.model, compilation)
        self._embed = compilation.region(action_tokens)
        compile_vision_layers(networks.paligemma.model, compilation)
        self._embed_image = networks.embed_image
        networks.embed_image = self._features
        super().__init__(model, compilation)

    def use_attention(self, attention: Attention) -> None:
        """Set the attention kernel of compiled steps."""
        self._expert.attention = attention

    def merge_products(self) -> None:
        self._language_model.merge_products()
        self._expert.merge_products()

    def encode(
        self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any
    ) -> tuple[Any, Any]:
        """Return keys and values, (P, layers, 2, heads, L, E), and the mask of the tokens, (P, L).

        The state is not used.
        """
        import torch  # torch's compiler follows this statement, but not `require`

        # One call encodes the images of all cameras.
        pixels = torch.stack(images, 1)
        features = self._embed_image(pixels.flatten(0, 1)).unflatten(0, pixels.shape[:2])
        embedded, present, _ = self.model.embed_prefix(
            list(features.unbind(1)), list(cameras.unbind(1)), tokens, mask
        )
        return self._language_model.encode(embedded, present), present.long()

    def constants(self, encoded: Any, present: Any, state: Any, horizon: int) -> tuple[Any, ...]:
        """Return `encoded`, the mask and the rotation; for π0, also the embedding of the state and
        the scales of the norms.
        """
        has_state = self._has_state_token
        tokens = horizon + has_state
        constants = self._expert.constants(encoded, present, tokens, has_state=has_state)
        if not has_state:
            return constants
        projection = self.model.state_proj
        embedded_state = projection(state.to(projection.weight.dtype))
        return *constants, embedded_state, self._expert.scales(len(state))

    def at_times(self, times: Any) -> Any:
        """Return the modulation of π0.5's norms, (B, K, norms, 3, 1, D), or the embeddings of the
        times of π0, (B, K, D).

        Times with a value for each row of a chunk are returned unchanged.
        """
        if self.by_row:
            return times
        if self._has_state_token:
            return self._embedded_times(times)
        modulation = self._expert.modulation(self._condition(times.flatten()))
        return modulation.unflatten(0, times.shape)

    def velocity(self, constants: Sequence[Any], actions: Any, times: Any) -> Any:
        encoded, mask, rotation, *of_state = constants
        if self._has_state_token:
            state, modulation = of_state
            embedded = self._embed(self.model, state, actions, times)
        else:
            modulation = times
            if self.by_row:
                modulation = self._expert.modulation(self._condition(times))
            embedded = self.model.action_in_proj(actions)

        hidden = self._expert.step(encoded, mask, rotation, modulation, embedded)
        return self.model.action_out_proj(hidden[:, -actions.shape[1] :].float())

    def _condition(self, times: Any) -> Any:
        """Return the condition of π0.5's norms: (rows, C) for times (rows,), or (rows, H, C) for
        times (rows, H).
        """
        tokens = times.shape[1] if times.ndim == 2 else 1
        # Only the embeddings of the actions depend on the actions, and they are not used.
        actions = times.new_zeros(len(times), tokens, self.model.action_in_proj.in_features)
        arguments = (None, actions, times) if self._takes_state else (actions, times)
        _, _, _, condition = self.model.embed_suffix(*arguments)
        return condition

    def _embedded_times(self, times: Any) -> Any:
        """Return the embeddings, (B, K, D), of times (B, K) that are the same for all rows."""
        settings = self.model.config
        embedded = self.module.create_sinusoidal_pos_embedding(
            times[0],
            self.model.action_in_proj.out_features,
            min_period=getattr(settings, "min_period", _MIN_PERIOD),
            max_period=getattr(settings, "max_period", _MAX_PERIOD),
            device=times.device,
        )
        return embedded.to(times.dtype).expand(len(times), -1, -1)

    def _features(self, image: Any) -> Any:
        """Return the features of an image (P, 3, H, W).

        Features (P, L, E) are returned unchanged.
        """
        return image if image.ndim == 3 else self._embed_image(image)
