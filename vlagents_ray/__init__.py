"""vlagents_ray: Vision-Language-Action models served with Ray, for robots and for evaluation.

Importing this package needs only numpy, simplejpeg and websockets, and loads neither ray nor torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vlagents_ray.client import ChunkPlayer, PlayerSettings, RemoteAgent
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
    from vlagents_ray.interface import Act, Agent, Obs, TrainableAgent
    from vlagents_ray.ray_tools.session import LocalServer, join

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
    "PlayerSettings",
    "PolicyFailed",
    "PolicyUnavailable",
    "RemoteAgent",
    "StateSpec",
    "TooManyRequests",
    "TrainableAgent",
    "Unauthorized",
    "UnknownSession",
    "VLAgentsError",
    "join",
]

_HOMES = ("errors", "contract", "interface", "images.codecs", "client", "ray_tools.session")


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that the command `vlagents-ray` can handle Ctrl-C while
    numpy is being loaded.
    """
    if name in __all__:
        for home in _HOMES:
            module = import_module(f"{__name__}.{home}")
            if hasattr(module, name):
                globals()[name] = getattr(module, name)
                return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
