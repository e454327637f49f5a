"""vlagents, the paper's own system: its server, and its `RemoteAgent` with mode "shm" or "jpeg".

The policy derives from its `Agent` and calls `super().act`, which decodes the cameras, as its documentation asks.
JPEG is what its client sends: simplejpeg's defaults, quality 85 and 4:4:4. The server is what `vlagents
start-server` starts. Its client changes the observation that it is given, so each call gets a new one.
"""

from __future__ import annotations

import sys
from typing import TextIO

import numpy as np
import peer
import rpyc
from vlagents import register_agent
from vlagents.client import RemoteAgent
from vlagents.policies.interface import Act, Agent, Obs, SingleObs
from vlagents.server import AgentService

NAME = "bench_noop"


class Noop(Agent):
    """Decodes the observation and returns seven zeros."""

    def __init__(self) -> None:
        super().__init__(default_checkpoint_path="")

    def act(self, obs: Obs) -> Act:
        super().act(obs)
        return self._single_step_act("robot", np.zeros(7, np.float32))


register_agent(NAME, Noop)


def serve(host: str, port: int) -> None:
    """As `vlagents start-server` does."""
    service = AgentService(Noop(), NAME)
    with service:
        rpyc.ThreadedServer(
            service, port=port, hostname=host, protocol_config={"allow_pickle": True, "allow_public_attrs": True}
        ).start()


def drive(host: str, port: int, path: str, mode: str, out: TextIO) -> None:
    """Its own client."""
    arrays = peer.observation(path)
    cameras = {name: image for name, image in arrays.items() if name.startswith("camera_")}

    def obs() -> Obs:
        robot = SingleObs(cameras=dict(cameras), gripper=float(arrays["gripper"]), joints=arrays["joints"])
        return Obs(obs={"robot": robot}, language_instruction="measure")

    agent = RemoteAgent(host, port, NAME, on_same_machine=mode == "shm", jpeg_encoding=mode == "jpeg")
    try:
        peer.obey(sys.stdin, out, lambda calls: peer.timed(obs, agent.act, calls), {})
    finally:
        agent.close()


if __name__ == "__main__":
    peer.run(serve, drive)
