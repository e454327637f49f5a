"""Environments for evaluating policies, with one file or folder for each simulator."""

from vlagents_ray.envs.base import EvalEnv, make_env

__all__ = ["EvalEnv", "make_env"]
