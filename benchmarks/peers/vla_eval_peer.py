"""vla-eval: its model server with a policy that does nothing, and its `Connection`.

Images are sent with vla-eval's default codec, PNG, unless `mode` names another codec ("jpeg",
"raw").

An evaluation is one model server and a `vla-eval run --no-docker` for each shard, all with one
recording, followed by `vla-eval export`, as in vla-eval's script for sharded runs. Videos are off,
which is the default; images are raw, since compression for a server on the same machine only costs
time. `run ...` and `export ...` are vla-eval's commands with these names.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import peer
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.cli.main import main
from vla_eval.connection import Connection
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import serve as serve_forever
from vla_eval.protocol.numpy_codec import set_image_format


class VlaEvalPolicy(PredictModelServer):
    """A model of vla-eval; it accepts batches if the policy does."""

    def __init__(self, policy: peer.Policy) -> None:
        super().__init__(max_batch_size=policy.batch)
        self._policy = policy

    def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
        return {"actions": self._policy()[0]}

    def predict_batch(
        self, obs_batch: list[dict[str, Any]], ctx_batch: list[Any]
    ) -> list[dict[str, Any]]:
        return [{"actions": action} for action in self._policy(len(obs_batch))]


class VlaEvalTimed(StepBenchmark):
    """The environment that all systems run; each shard imports it by name."""

    def __init__(self, seed: int, env: dict[str, Any]) -> None:
        from benchmarks.environments import TimedEnv
        from vlagents_ray.interface import Act

        super().__init__()
        set_image_format("raw")
        self._seed = seed
        self._env, self._act = TimedEnv(**env), Act

    def get_tasks(self) -> list[dict[str, Any]]:
        return [{"name": "timed"}]

    def reset(self, task: dict[str, Any]) -> Any:
        return self._env.reset(seed=self._seed + task["episode_idx"])[0]

    def step(self, action: dict[str, Any]) -> StepResult:
        obs, reward, terminated, truncated, info = self._env.step(
            self._act(action["actions"][: self._env.contract.action.dim])
        )
        return StepResult(obs, reward, terminated or truncated, info)

    def make_obs(self, raw_obs: Any, task: dict[str, Any]) -> dict[str, Any]:
        state = np.concatenate(list(raw_obs.state.values()))
        return {
            "images": raw_obs.cameras,
            "task_description": self._env.instruction,
            "state": state,
        }

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        return {"success": step_result.info["success"]}


def serve(host: str, port: int, policy: peer.Policy) -> None:
    """Run the server as vla-eval's `run_server` does."""
    serve_forever(VlaEvalPolicy(policy), host, port)


def connect(target: peer.Target) -> peer.Client:
    """Connect vla-eval's own client, on a new event loop."""
    if target.mode != "png":
        set_image_format(target.mode)
    obs = {"images": target.cameras, "task_description": "measure", "state": target.state}
    loop = asyncio.new_event_loop()
    connection = Connection(f"ws://{target.host}:{target.port}")
    loop.run_until_complete(connection.connect())
    loop.run_until_complete(connection.start_episode({"task": {"name": "measure"}}))
    return peer.Client(
        lambda: obs, lambda obs: loop.run_until_complete(connection.act(obs))["actions"]
    )


def evaluate(host: str, port: int, plan: dict[str, Any]) -> None:
    """Start the server, run the shards, and export their results."""
    folder = Path(plan["folder"])
    benchmark = {
        "benchmark": "vla_eval_peer:VlaEvalTimed",
        "episodes_per_task": plan["episodes"],
        "max_steps": plan["env"]["max_steps"],
        "params": {"seed": plan["seed"], "env": plan["env"]},
    }
    config = folder / "run.yaml"
    config.write_text(
        json.dumps({"server": {"url": f"ws://{host}:{port}"}, "benchmarks": [benchmark]})
    )
    common = [
        "--output-dir",
        str(folder),
        "--eval-id",
        "bench",
        "--num-shards",
        str(plan["workers"]),
        "--shard-id",
    ]
    server = _start("serve", host, str(port), "{}")
    peer.wait_for_port(host, port)
    shards = [
        _start("run", "--no-docker", "--config", str(config), *common, str(shard))
        for shard in range(plan["workers"])
    ]
    for shard in shards:
        _wait(shard)
    _wait(_start("export", str(folder / "recording-bench.sqlite")))
    server.communicate()


def _wait(command: subprocess.Popen[bytes]) -> None:
    if command.wait():
        raise RuntimeError(f"{command.args} ended with exit status {command.returncode}")


def _start(*words: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, __file__, *words], stdin=subprocess.PIPE)


if __name__ == "__main__":
    if sys.argv[1] in ("run", "export"):
        peer.die_with_parent()
        main()
    else:
        peer.run(serve, connect, evaluate)
