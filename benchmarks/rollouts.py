"""Steps a second of `Rollouts` against a plain loop of the same environments and policy in one process, in turns.

The loop is what a learner writes first: environments stepped one after another, one call of the policy for all of them,
arrays of what came of it. `Rollouts` steps as many environments in all, in workers, and asks a server.
"""

from __future__ import annotations

import contextlib
import itertools
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, ClassVar

import numpy as np
import typer

from vlagents_ray.cli.console import out
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.learn import Rollouts
from vlagents_ray.registry import policy_class
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

_POLICIES: dict[str, tuple[str, dict[str, Any]]] = {
    "tiny": ("benchmarks.rollouts:Tiny", {}),
    "slow": ("noop", {"action_dim": 4, "base_ms": 20, "per_item_ms": 1}),
}


class Tiny(Agent):
    """Two layers of 64 on the state of the tabletop."""

    shared: ClassVar[tuple[str, ...]] = ("layers",)

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=4))

    def initialize(self) -> None:
        rng = np.random.default_rng(0)
        self.layers = [rng.normal(0, size[0] ** -0.5, size).astype(np.float32) for size in ((7, 64), (64, 64), (64, 4))]

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        rows = np.array([(*one.state["xyzrpy"], one.gripper) for one in obs], np.float32)
        for layer in self.layers:
            rows = np.tanh(rows @ layer)
        return [Act(row) for row in rows]


def loop(agent: Agent, num_envs: int, episodes: int, options: dict[str, Any], *, images: bool) -> float:
    """Return the steps a second of `episodes` episodes in this process."""
    envs = [Tabletop(**options) for _ in range(num_envs)]
    seeds, steps, begun = itertools.count(), 0, time.perf_counter()
    for _ in range(episodes // num_envs):
        seen = [env.reset(seed=next(seeds))[0] for env in envs]
        rows: list[tuple[Any, ...]] = []
        for _ in range(envs[0].max_steps):
            acts = agent.act_batch(seen, [agent] * num_envs)
            done = [env.step(act) for env, act in zip(envs, acts, strict=True)]  # type: ignore[arg-type]
            kept = [(one.cameras["front"],) if images else () for one in seen]
            rows += [
                (obs.state["xyzrpy"], act.action, step[1], *image)  # type: ignore[union-attr]
                for obs, act, step, image in zip(seen, acts, done, kept, strict=True)
            ]
            seen = [step[0] for step in done]
            steps += num_envs
        for column in zip(*rows, strict=True):
            np.stack(column)
    return steps / (time.perf_counter() - begun)


@contextlib.contextmanager
def served(policy: str, config: dict[str, Any], patience: float, **settings: Any) -> Iterator[Callable[[int], float]]:
    """Yield a function that returns the steps a second of so many episodes of `Rollouts` with these settings."""
    document = deployment(policy, config=config, batch={"patience": patience})
    app = document.applications[0].name
    with (
        running_server(document, num_cpus=settings["workers"] + 2, ingress=False),
        Rollouts("tabletop", f"serve://{app}", **settings) as rollouts,
    ):
        rollouts.collect(4 * settings["workers"] * settings["num_envs"])  # workers start, and make their environments

        def measure(episodes: int) -> float:
            begun = time.perf_counter()
            steps: int = rollouts.collect(episodes).num_rows
            return steps / (time.perf_counter() - begun)

        yield measure


def main(
    policy: Annotated[str, typer.Argument(help=f"one of {', '.join(_POLICIES)}")] = "tiny",
    workers: Annotated[int, typer.Option(help="Workers of the rollouts.")] = 2,
    num_envs: Annotated[int, typer.Option(help="Environments of each worker.")] = 8,
    episodes: Annotated[int, typer.Option(help="Episodes of each way in each round.")] = 64,
    rounds: Annotated[int, typer.Option(help="Rounds.")] = 3,
    patience: Annotated[float, typer.Option(help="`batch.patience` of the server.")] = 0.5,
    size: Annotated[int, typer.Option(help="Pixels a side.")] = 224,
    images: Annotated[bool, typer.Option(help="Whether images are kept.")] = True,
) -> None:
    """Print the steps a second of both, and their ratio in each round."""
    name, config = _POLICIES[policy]
    options = {"width": size, "height": size}
    agent = policy_class(name).from_config(config)
    agent.initialize()
    ratios = []
    with served(
        name, config, patience, workers=workers, num_envs=num_envs, images=images, env_options=options
    ) as measure:
        for _ in range(rounds):
            plain = loop(agent, workers * num_envs, episodes, options, images=images)
            ours = measure(episodes)
            ratios.append(ours / plain)
            out.print(f"loop {plain:.0f} steps/s, rollouts {ours:.0f} steps/s: {ratios[-1]:.2f}")
    out.print(f"median {statistics.median(ratios):.2f}")


if __name__ == "__main__":
    typer.run(main)
