"""ARRO (arXiv 2505.08627): show a policy the gripper and the things it is to handle, on a virtual background.

On the first frame a detector finds the things, a segmenter cuts them out, a selector chooses the
gripper among regions of the image; a tracker follows these segments from frame to frame, and what
is outside them is painted over. Detector, segmenter, selector and tracker are exchangeable:
`vlagents_ray.policies.arro.parts`.
"""

from vlagents_ray.policies.arro.config import ArroConfig
from vlagents_ray.policies.arro.wrapper import Arro

__all__ = ["Arro", "ArroConfig"]
