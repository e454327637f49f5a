"""What a type of LeRobot's policies computes for the sessions of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base import Row
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import RandomSteps
from vlagents_ray.registry import require

IMAGES = "observation.images"
FRAMES = (
    "observation.state",
    "observation.environment_state",
    IMAGES,
)  # inputs of each step of a history


class Kind:
    """The default for any type: one row at a time with a seed of its session, which is slow and exact."""

    batched = False
    random: RandomSteps | None = None  # of the last chunks that were drawn

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        """Use a loaded policy, and mark its cores for compilation if its type has any."""
        self.policy, self.config = policy, policy.config
        if type(self) is Kind and self.steps > 1:
            raise ConfigError(
                f"checkpoint: {policy.name!r} keeps {self.steps} observations by itself, so that sessions would mix; "
                f"want another type, or a policy with n_obs_steps 1"
            )

    @property
    def steps(self) -> int:
        """The number of observations that the policy gets."""
        return int(self.config.n_obs_steps)

    @property
    def horizon(self) -> int:
        """The number of rows of a chunk, from the current tick on."""
        return int(getattr(self.config, "chunk_size", 0) or self.config.n_action_steps)

    @property
    def dim(self) -> int:
        """The number of values in an action that the policy returns to its post-processor."""
        return int(self.config.action_feature.shape[0])

    @property
    def usual(self) -> int:
        """The number of rows that the policy executes before the next inference, by its config."""
        return min(int(getattr(self.config, "n_action_steps", self.horizon)), self.horizon)

    def observations(self, rows: Sequence[Row]) -> list[int]:
        """Return the indices of the rows whose observations `draw` needs: all, unless samples share one."""
        return list(range(len(rows)))

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        """Compute chunks in the policy's own units.

        Args:
            batch: The output of the policy's pre-processor, for the rows of `observations`.
            rows: The rows of the batch.
            leftovers: The leftover actions of each row, (H', D) in the same units, or None.

        Returns:
            The chunks, (B, horizon, D).
        """
        from vlagents_ray.policies.sampling_rng import seeded

        [row] = rows
        with seeded(row.rng, require("torch").device(self.config.device)):
            self.policy.reset()
            return self._alone(batch, row)

    def _alone(self, batch: dict[str, Any], row: Row) -> Any:
        return self.policy.predict_action_chunk(batch)


def vectors(config: Any) -> list[str]:
    """Return the observation keys of the vectors that a policy reads."""
    features = {FRAMES[0]: config.robot_state_feature, FRAMES[1]: config.env_state_feature}
    return [key for key, feature in features.items() if feature]


def stacked(batch: dict[str, Any], config: Any, rows: int) -> dict[str, Any]:
    """Reshape (rows * steps, …) to (rows, steps, …), with the cameras in one tensor (rows, steps, cameras, 3, H, W)."""
    if config.image_features:
        images = [batch[key] for key in config.image_features]
        batch = {**batch, IMAGES: require("torch").stack(images, dim=1)}
    return {key: batch[key].unflatten(0, (rows, -1)) for key in FRAMES if key in batch}
