"""Faster forward passes of torch policies: compiled cores, CUDA graphs, kept programs, and weights of 8 bits."""

from vlagents_ray.policies.compilation.cores import Compilation, CompileMode
from vlagents_ray.policies.compilation.quantization import Quantization, quantize, require_whole

__all__ = ["Compilation", "CompileMode", "Quantization", "quantize", "require_whole"]
