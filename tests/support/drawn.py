"""An env whose images something draws, as it says."""

from __future__ import annotations

from eval_fakes import Line

from vlagents_ray.envs.graphics import Renderer


class Drawn(Line):
    """By Mesa, in software."""

    def renderer(self) -> Renderer:
        return Renderer("llvmpipe (LLVM 15.0.6, 256 bits)", software=True, cuda=None)
