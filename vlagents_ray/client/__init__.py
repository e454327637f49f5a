"""The client, which represents a remote policy as an `Agent`; it runs on the robot or in the
environment's process.
"""

from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.client.agent import RemoteAgent

__all__ = ["ChunkPlayer", "PlayerSettings", "RemoteAgent"]
