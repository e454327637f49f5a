"""LeRobot's policies by flow matching, whose chunks go on from the leftovers of their sessions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vlagents_ray.policies.base import Row, shared_frames
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import Change, RandomSteps
from vlagents_ray.policies.flow_passes import FlowPasses, Pi0Passes
from vlagents_ray.policies.lerobot.kinds.guidance import Guidance
from vlagents_ray.policies.lerobot.kinds.kind import Kind
from vlagents_ray.policies.lerobot.kinds.smolvla import SmolVLAPasses
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
