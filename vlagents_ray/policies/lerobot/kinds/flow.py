"""LeRobot's policies by flow matching, whose chunks go on from the leftovers of their sessions."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

import numpy as np

from vlagents_ray.policies.base import Row, shared_frames
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import Change, RandomSteps
from vlagents_ray.policies.flow_passes import FlowPasses, Pi0Passes, cache_of, layers_of
from vlagents_ray.policies.lerobot.kinds.kind import Kind
from vlagents_ray.registry import require


class Flow(Kind):
    """SmolVLA, π0 and π0.5: flow matching from noise of the sessions, guided by their leftovers.

    What an observation is encoded to is shared by the samples of its session.
    """

    batched = True
    noise_level = 0.0  # as for `RandomSteps`

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        self.guidance = Guidance(policy.rtc_processor)
        model = policy.model
        if policy.name == "smolvla":
            self.passes: FlowPasses = SmolVLAPasses(model, compilation)
        else:
            self.passes = Pi0Passes(model, compilation, stated=policy.name == "pi0")
        # The policy calls it between its own preparation of inputs and actions.
        model.sample_actions = self.passes.sample

    @property
    def flow_steps(self) -> int:
        """The number of steps from noise to actions."""
        config = self.config
        return int(config.num_steps if config.type == "smolvla" else config.num_inference_steps)

    def observations(self, rows: Sequence[Row]) -> list[int]:
        return self._shared(rows)[0]

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        torch = require("torch")
        shape = (self.horizon, int(self.config.max_action_dim))

        def convert(array: np.ndarray) -> Any:
            return torch.from_numpy(array).to(self.config.device)

        noise = convert(np.stack([row.noise(*shape) for row in rows]))  # before the steps', which only some rows draw
        self.random = RandomSteps.of(rows, (self.flow_steps, *shape), self.noise_level, convert)
        changes: list[Change] = []
        if any(left is not None for left in leftovers):
            plans = [None if left is None else self._encoded(left) for left in leftovers]
            changes.append(self.guidance.towards(plans, [row.delay for row in rows], shape, self.config.device))
        if self.random is not None:
            changes.append(self.random.change)
        return self.policy.predict_action_chunk(
            batch,
            noise=noise,
            owners=self._shared(rows)[1],
            fingerprints=[row.adapter for row in rows],
            steps=self.flow_steps,
            changes=changes,
        )

    def _shared(self, rows: Sequence[Row]) -> tuple[list[int], list[int]]:
        """Return the rows whose observations are read, and the place among these of that of each row."""
        if getattr(self.config, "use_relative_actions", False):  # the state of each row is added to its actions
            return list(range(len(rows))), list(range(len(rows)))
        return shared_frames(rows)

    def _encoded(self, left: Any) -> Any:
        """Convert a leftover to the units of π0's ALOHA, if SmolVLA was trained in these."""
        if not getattr(self.config, "adapt_to_pi_aloha", False):
            return left
        return self.policy._pi_aloha_encode_actions_inv(left[None].clone())[0]


class Guidance:
    """Guides chunks as the `RTCProcessor` of a flow-matching policy of LeRobot does, whose settings it has."""

    def __init__(self, processor: Any) -> None:
        self._processor = processor  # its settings and schedule are used

    def towards(self, plans: Sequence[Any], delays: Sequence[int], shape: tuple[int, int], device: Any) -> Change:
        """Return the change of velocities that leads chunks to the leftovers of their sessions.

        Args:
            plans: The leftover of each of the B rows in the policy's units, (H', D'), or None.
            delays: The number of rows of each that will have been executed.
            shape: Rows and numbers of a chunk, (H, D).
            device: The policy's device.
        """
        torch = require("torch")
        target, weights = torch.zeros(len(plans), *shape), torch.zeros(len(plans), shape[0], 1)
        for i, (plan, delay) in enumerate(zip(plans, delays, strict=True)):
            if plan is not None:
                part = plan[: shape[0]]
                target[i, : len(part), : part.shape[1]] = part
                weights[i, :, 0] = self._weights(delay, len(part), shape[0])
        target, weights = target.to(device), weights.to(device)

        def change(velocity: Any, actions: Any, time: float) -> Any:
            end = actions - time * velocity
            return velocity - self._strength(time) * weights * (target - end)

        return change

    def _weights(self, delay: int, leftover: int, chunk: int) -> Any:
        """Return the weight of the leftover in each row of a chunk, (chunk,) float32 in [0, 1]."""
        horizon = min(self._processor.rtc_config.execution_horizon, leftover)
        return self._processor.get_prefix_weights(max(delay, 0), horizon, chunk)

    def _strength(self, time: float) -> float:
        """Return g for LeRobot's time, which runs from 1 (noise) to 0."""
        most = float(self._processor.rtc_config.max_guidance_weight)
        done = 1 - time
        return most if done == 0 else min(most, time / done * (time**2 + done**2) / time**2)


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

    def encode_images(self, images: Sequence[Any]) -> list[Any]:
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
