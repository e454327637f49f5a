"""Episodes for the viewers Rerun and Foxglove: files that they open, or a live connection to them.

The extras "rerun" and "foxglove" install their SDKs. What is shown never delays what is shown: see
`vlagents_ray.viewers.viewer`.
"""

from vlagents_ray.viewers.targets import open_viewers
from vlagents_ray.viewers.viewer import EpisodeViewer, ViewerFrame

__all__ = ["EpisodeViewer", "ViewerFrame", "open_viewers"]
