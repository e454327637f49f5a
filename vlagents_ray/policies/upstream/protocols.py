"""The client of each protocol, by the name that a deployment gives."""

from __future__ import annotations

from vlagents_ray.policies.upstream.clients.base import UpstreamClient
from vlagents_ray.policies.upstream.clients.gr00t import GR00TClient
from vlagents_ray.policies.upstream.clients.lerobot import LeRobotClient
from vlagents_ray.policies.upstream.clients.openpi import OpenPiBatchClient, OpenPiClient, RoboArenaClient
from vlagents_ray.policies.upstream.clients.openvla import OpenVLAClient
from vlagents_ray.policies.upstream.clients.vla_eval import VlaEvalClient
from vlagents_ray.policies.upstream.clients.vlagents import VlagentsClient
from vlagents_ray.policies.upstream.clients.xpolicylab import XPolicyLabClient

PROTOCOLS: dict[str, type[UpstreamClient]] = {
    "openpi": OpenPiClient,
    "openpi-batch": OpenPiBatchClient,
    "roboarena": RoboArenaClient,
    "gr00t": GR00TClient,
    "openvla": OpenVLAClient,
    "vla_eval": VlaEvalClient,
    "vlagents": VlagentsClient,
    "lerobot": LeRobotClient,
    "xpolicylab": XPolicyLabClient,
}
