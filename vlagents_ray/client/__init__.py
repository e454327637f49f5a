"""What runs on the robot or beside the env: a remote policy as an `Agent`."""

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.chunks import ChunkPlayer

__all__ = ["ChunkPlayer", "RemoteAgent"]
