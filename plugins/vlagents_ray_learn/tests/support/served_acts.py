"""The first act of an episode at a server."""

from __future__ import annotations

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.serve.launch.server import Server


def first_act(server: Server, app: str, transport: str) -> tuple[int, float]:
    """Version of the weights, and first number of the action, of the first act of an episode."""
    url = f"serve://{app}" if transport in ("handle", "plasma") else server.url
    with RemoteAgent(url, transport=transport, priority="simulation") as agent:
        agent.reset(Obs(), None)
        act = agent.act(Obs())
        return act.info["policy"]["version"], float(act.action[0])
