"""The built-in tabletop: coloured pucks and pads, a gripper, and instructions that select among them.

It is plain numpy, without simulator or graphics driver, so that a first run works anywhere.

Base frame: origin in the middle of the table's surface, x to the right in the image, y away from the camera, z up;
metres. The camera "front" looks down at an elevation of 70 degrees without perspective: the view's shorter side spans
0.66 m and the origin lies in the image's centre, so that

    u = width / 2 + s * x,   v = height / 2 - s * (y * sin 70° + z * cos 70°),   s = min(width, height) / 0.66 m

The camera "wrist" shows a third of that, enlarged, with the fingertips in its centre.
"""

from vlagents_ray.envs.tabletop.env import Tabletop

__all__ = ["Tabletop"]
