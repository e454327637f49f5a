"""The common parts of the model families: settings, checkpoints, and sessions with action
chunks.
"""

from vlagents_ray.policies.base.config import AdapterConfig, ModelConfig
from vlagents_ray.policies.base.model_inputs import Row, shared_frames
from vlagents_ray.policies.base.policy import ModelPolicy, Prediction

__all__ = ["AdapterConfig", "ModelConfig", "ModelPolicy", "Prediction", "Row", "shared_frames"]
