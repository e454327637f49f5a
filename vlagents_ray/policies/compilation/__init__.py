"""Compiled forward passes of torch policies: cores, CUDA graphs, and programs that are kept on disk."""

from vlagents_ray.policies.compilation.cores import Compilation, CompileMode

__all__ = ["Compilation", "CompileMode"]
