"""What the adapters of model families share: settings, checkpoints, sessions of chunked actions."""

from vlagents_ray.policies.base.config import ModelConfig
from vlagents_ray.policies.base.policy import ModelPolicy
from vlagents_ray.policies.base.row import Prediction, Row

__all__ = ["ModelConfig", "ModelPolicy", "Prediction", "Row"]
