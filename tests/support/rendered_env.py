"""An environment that reports the renderer of its images."""

from __future__ import annotations

from eval_fakes import Line

from vlagents_ray.envs.graphics import Renderer


class Drawn(Line):
    """An environment that reports Mesa's software renderer."""

    def renderer(self) -> Renderer:
        return Renderer("llvmpipe (LLVM 15.0.6, 256 bits)", software=True, cuda=None)
