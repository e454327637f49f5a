"""The client, which runs on the robot or with the environment: a remote policy as an `Agent`."""

from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.client.agent import RemoteAgent

__all__ = ["ChunkPlayer", "PlayerSettings", "RemoteAgent"]
