"""vlagents, the paper's own system: its server, and its `RemoteAgent` with mode "shm" or "jpeg".

The policy derives from vlagents' `Agent` and calls `super().act`, which decodes the cameras, as
vlagents' documentation requires. The client sends JPEG with simplejpeg's defaults, quality 85 and
4:4:4. The server is that of `vlagents start-server`. The client changes the observation, so each
call gets a new observation.

An evaluation is vlagents' `run-eval` with `same_machine`, raw images, and no videos. Each
configuration has its own process and server, so several processes are several configurations of one
environment, with consecutive seeds. `start-server ...` is vlagents' command with this name, with
this file's agent registered.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import peer
import rpyc
from vlagents import register_agent, register_env
from vlagents.__main__ import main_app
from vlagents.client import RemoteAgent
from vlagents.envs.interface import EvalEnv
from vlagents.policies.interface import Act, Agent, Obs, SingleAct, SingleObs
from vlagents.server import AgentService

NAME = "bench_noop"
ENV = "bench_tabletop"


class VlagentsPolicy(Agent):
    """Decodes the observation and runs the policy. `run-eval` passes a device to every policy."""

    policy = peer.Policy()

    def __init__(self, device: str | None = None, checkpoint_step: int | None = None) -> None:
        super().__init__(default_checkpoint_path="", checkpoint_step=checkpoint_step)

    def act(self, obs: Obs) -> Act:
        super().act(obs)
        return self._chunk_act("robot", self.policy().reshape(-1, 7))


class VlagentsTabletop(EvalEnv):
    """The environment that all systems run."""

    def do_import(self) -> None:
        from benchmarks.environments import TimedEnv
        from vlagents_ray.interface import Act

        self._make, self._act = TimedEnv, Act

    def make_gym(self) -> Any:
        return self._make(**self.env_kwargs)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        # This is called after each episode; the observation is not used, so it costs nothing here.
        if seed is None:
            return self._last, {}
        obs, info = self.env.reset(seed=seed)
        return self._translated(obs), info

    def step(self, action: dict[str, SingleAct]) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        obs, *rest = self.env.step(self._act(action["robot"].action[:4]))
        return self._translated(obs), *rest

    @property
    def language_instruction(self) -> str:
        return str(self.env.instruction)

    def _translated(self, obs: Any) -> Obs:
        robot = SingleObs(
            cameras=dict(obs.cameras),
            gripper=obs.gripper,
            xyzrpy=obs.state["xyzrpy"],
            info={"high_res_cameras": {}},  # the cameras for videos; without this key, all cameras
        )
        self._last = Obs(obs={"robot": robot}, language_instruction=self.env.instruction)
        return self._last


register_agent(NAME, VlagentsPolicy)
register_env(ENV, VlagentsTabletop)


def serve(host: str, port: int, policy: peer.Policy) -> None:
    """Run the server as `vlagents start-server` does."""
    VlagentsPolicy.policy = policy
    service = AgentService(VlagentsPolicy(), NAME)
    with service:
        rpyc.ThreadedServer(
            service,
            port=port,
            hostname=host,
            protocol_config={"allow_pickle": True, "allow_public_attrs": True},
        ).start()


def connect(target: peer.Target) -> peer.Client:
    """Connect vlagents' own client."""
    gripper, joints = float(target.arrays["gripper"]), target.arrays["joints"]

    def observe() -> Obs:
        robot = SingleObs(cameras=dict(target.cameras), gripper=gripper, joints=joints)
        return Obs(obs={"robot": robot}, language_instruction="measure")

    agent = RemoteAgent(
        target.host,
        target.port,
        NAME,
        on_same_machine=target.mode == "shm",
        jpeg_encoding=target.mode == "jpeg",
    )
    return peer.Client(observe, lambda obs: agent.act(obs).acts[0]["robot"].action, agent.close)


def evaluate(host: str, port: int, plan: dict[str, Any]) -> None:
    """Run vlagents' `run-eval`; further processes use the next ports."""
    folder = Path(plan["folder"])
    # `run-eval` starts PYTHON -m vlagents start-server ..., which does not know our agent.
    server = folder / "python"
    server.write_text(f"#!/bin/sh\nshift 2\nexec '{sys.executable}' '{__file__}' \"$@\"\n")
    server.chmod(0o755)
    each = plan["episodes"] // plan["workers"]
    configs = [
        {
            "env_id": ENV,
            "env_kwargs": plan["env"],
            "max_steps_per_episode": plan["env"]["max_steps"],
            "seed": plan["seed"] + process * each,
            "same_machine": True,
            "image_size": None,
        }
        for process in range(plan["workers"])
    ]
    agent = {
        "host": host,
        "port": port,
        "agent_name": NAME,
        "agent_kwargs": {},
        "python_path": str(server),
    }
    words = [
        "run-eval",
        f"--output-path={folder}",
        f"--episodes={each}",
        f"--n-processes={plan['workers']}",
        f"--eval-cfgs={json.dumps(configs)}",
        f"--agent-cfg={json.dumps(agent)}",
    ]
    main_app(words, standalone_mode=False)


if __name__ == "__main__":
    if sys.argv[1] == "start-server":
        peer.die_with_parent()
        main_app()
    else:
        peer.run(serve, connect, evaluate)
