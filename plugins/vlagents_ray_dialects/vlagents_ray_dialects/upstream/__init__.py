"""Serves the models of other policy servers through our queue, sessions, keys, evaluation and live
view.
"""

from vlagents_ray_dialects.upstream.policy import Upstream

__all__ = ["Upstream"]
