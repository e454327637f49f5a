"""ARRO (arXiv 2505.08627) shows a policy only the gripper and the objects of its task, on a virtual
background.

On the first frame a detector finds the objects, a segmenter computes their masks, and a selector
chooses the gripper among regions of the image. A tracker follows these segments from frame to
frame, and all other pixels are painted over. Detector, segmenter, selector and tracker are
exchangeable; `vlagents_ray_arro.parts` has their interfaces.
"""

from vlagents_ray_arro.wrapper import Arro, ArroConfig

__all__ = ["Arro", "ArroConfig"]
