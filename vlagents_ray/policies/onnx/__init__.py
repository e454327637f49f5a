"""Exported policies, ONNX files and TorchScript archives, whose inputs and outputs a deployment file maps."""

from vlagents_ray.policies.onnx.config import OnnxConfig
from vlagents_ray.policies.onnx.policy import Onnx

__all__ = ["Onnx", "OnnxConfig"]
