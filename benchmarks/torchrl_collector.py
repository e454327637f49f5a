"""TorchRL's collector with its inference server, for `benchmarks.rollouts`: `pip install
torchrl`.
"""

from __future__ import annotations

import functools
import itertools
import time
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.collectors import AsyncBatchedCollector
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules.inference_server import InferenceServerConfig

from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import policy_class

_TIMEOUT_S = 0.02  # maximum time for which the server waits for a whole batch, s


class TorchTabletop(EnvBase):  # type: ignore[misc]
    """The tabletop as an environment of TorchRL."""

    def __init__(self, first_seed: int, options: dict[str, Any]) -> None:
        super().__init__(device="cpu", batch_size=())
        self._env, self._seeds = Tabletop(**options), itertools.count(first_seed, 1000)
        flag = Categorical(2, shape=(1,), dtype=torch.bool)
        self.observation_spec = Composite(
            pixels=Unbounded((options["height"], options["width"], 3), dtype=torch.uint8),
            state=Unbounded((7,)),
        )
        self.action_spec, self.reward_spec = Bounded(-1.0, 1.0, (4,)), Unbounded((1,))
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone())

    def _reset(self, _: TensorDictBase | None = None, **__: Any) -> TensorDict:
        obs, _ = self._env.reset(seed=next(self._seeds))
        return TensorDict(_tensors(obs), ())

    def _step(self, acts: TensorDictBase) -> TensorDict:
        obs, reward, terminated, truncated, _ = self._env.step(Act(acts["action"].numpy()))
        flags = {"terminated": terminated, "truncated": truncated, "done": terminated or truncated}
        return TensorDict(
            {
                **_tensors(obs),
                "reward": torch.tensor([reward]),
                **{name: torch.tensor([flag]) for name, flag in flags.items()},
            },
            (),
        )

    def _set_seed(self, seed: int | None) -> None:
        pass


def _tensors(obs: Obs) -> dict[str, torch.Tensor]:
    state = np.array((*obs.state["xyzrpy"], obs.gripper), np.float32)
    return {"pixels": torch.from_numpy(obs.cameras["front"]), "state": torch.from_numpy(state)}


class TorchPolicy(torch.nn.Module):  # type: ignore[misc]
    """A policy of the benchmark, which is called with as many rows as TorchRL's server has
    requests.
    """

    def __init__(self, name: str, config: dict[str, Any]) -> None:
        super().__init__()
        self._agent = policy_class(name).from_config(config)
        self._agent.initialize()

    def forward(self, state: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
        rows = state.numpy().reshape(-1, 7)
        seen = [Obs(state={"xyzrpy": row[:6]}, gripper=row[6]) for row in rows]
        acts = self._agent.act_batch(seen, [self._agent] * len(seen))
        return torch.from_numpy(np.stack([act.action for act in acts])).reshape(
            *state.shape[:-1], 4
        )


def _module(name: str, config: dict[str, Any], in_keys: list[str]) -> TensorDictModule:
    return TensorDictModule(TorchPolicy(name, config), in_keys=in_keys, out_keys=["action"])


def rate(
    policy: str,
    config: dict[str, Any],
    options: dict[str, Any],
    episodes: int,
    *,
    workers: int,
    num_envs: int,
    grouped: bool,
    whole_batches: bool,
    images: bool,
) -> float:
    """Return the steps per second of TorchRL's collector. Call this function in a separate process,
    since the collector's threads never idle.

    Args:
        policy: The policy's name.
        config: The policy's settings.
        options: The options of the environments.
        episodes: Number of measured episodes, a multiple of the number of environments.
        workers: Number of processes with environments.
        num_envs: Number of environments in each process.
        grouped: Whether a process holds `num_envs` environments, which the coordinator in this
            process steps; if not, each environment has its own process, which calls the server's
            process itself.
        whole_batches: Whether the server waits for the requests of all environments.
        images: Whether the policy receives the images.
    """
    total, steps = workers * num_envs, Tabletop(**options).max_steps
    server = InferenceServerConfig(
        max_batch_size=total,
        min_batch_size=total if whole_batches else 1,
        timeout=_TIMEOUT_S if whole_batches else 0.0,
    )
    collector = AsyncBatchedCollector(
        [functools.partial(TorchTabletop, i, options) for i in range(total)],
        policy_factory=functools.partial(
            _module, policy, config, ["state", "pixels"] if images else ["state"]
        ),
        frames_per_batch=total * steps,
        env_backend="multiprocessing",
        envs_per_worker=num_envs if grouped else 1,
        transport="driver" if grouped else "auto",
        transition_chunk_size="auto" if grouped else steps,
        server_config=server,
    )
    try:
        batches = iter(collector)
        next(batches)  # starts the processes
        begun = time.perf_counter()
        frames: int = sum(next(batches).numel() for _ in range(episodes // total))
        return frames / (time.perf_counter() - begun)
    finally:
        collector.shutdown()
