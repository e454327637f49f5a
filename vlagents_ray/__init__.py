"""vlagents_ray: Vision-Language-Action models served with Ray, for robots and for evaluation.

This is the light install: it needs numpy, simplejpeg and websockets, and loads neither ray nor torch.
"""

from vlagents_ray.client import ChunkPlayer, RemoteAgent
from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import (
    ConfigError,
    ConnectionLost,
    ContractMismatch,
    DeadlineExceeded,
    Forbidden,
    InvalidInput,
    InvalidObservation,
    NotReset,
    PolicyFailed,
    PolicyUnavailable,
    TooManyRequests,
    Unauthorized,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray.images.codecs import ImageCodec
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.ray_tools.local_servers import LocalServer, join

__all__ = [
    "Act",
    "ActionSpec",
    "Agent",
    "CameraSpec",
    "ChunkPlayer",
    "ConfigError",
    "ConnectionLost",
    "Contract",
    "ContractMismatch",
    "DeadlineExceeded",
    "Forbidden",
    "ImageCodec",
    "InvalidInput",
    "InvalidObservation",
    "LocalServer",
    "NotReset",
    "Obs",
    "PolicyFailed",
    "PolicyUnavailable",
    "RemoteAgent",
    "StateSpec",
    "TooManyRequests",
    "Unauthorized",
    "UnknownSession",
    "VLAgentsError",
    "join",
]
