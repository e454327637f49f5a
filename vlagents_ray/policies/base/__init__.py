"""The common parts of the model families' adapters: settings, checkpoints, sessions of chunked actions."""

from vlagents_ray.policies.base.config import ModelConfig
from vlagents_ray.policies.base.policy import ModelPolicy, Prediction, Row, shared_frames

__all__ = ["ModelConfig", "ModelPolicy", "Prediction", "Row", "shared_frames"]
