"""Steps a second of `Rollouts` against a plain loop of the same environments and policy in one process, in turns.

The loop is a learner's first program: it steps environments one after another, calls the policy once for all, and
collects arrays. `Rollouts` steps as many environments in workers, with a server. With `--torchrl`, TorchRL's collector
with its inference server also takes its turns.
"""

from __future__ import annotations

import contextlib
import itertools
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Annotated, Any, ClassVar

import numpy as np
import typer

from vlagents_ray.cli.console import out
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.learn import RolloutPlan, Rollouts
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
    """Yield a function that returns the steps a second of n episodes of `Rollouts` with these settings."""
    document = deployment(policy, config=config, batch={"patience": patience})
    app = document.applications[0].name
    with (
        running_server(document, num_cpus=settings["workers"] + 2, ingress=False),
        Rollouts(RolloutPlan("tabletop", f"serve://{app}", **settings)) as rollouts,
    ):
        rollouts.collect(4 * settings["workers"] * settings["num_envs"])  # workers start, and make their environments

        def measure(episodes: int) -> float:
            begun = time.perf_counter()
            steps: int = rollouts.collect(episodes).num_rows
            return steps / (time.perf_counter() - begun)

        yield measure


def torchrl_rate(layout: str, policy: str, episodes: int, **settings: Any) -> float:
    """Return the steps a second of TorchRL's collector, measured in a new process by `rate` there."""
    try:
        from benchmarks.torchrl_collector import rate
    except ModuleNotFoundError as error:
        raise typer.BadParameter(f"TorchRL is not installed ({error}): pip install torchrl") from error
    slow = policy == "slow"
    name, config = _POLICIES[policy]
    settings |= {"grouped": layout == "grouped", "whole_batches": slow, "images": slow}
    with ProcessPoolExecutor(1, get_context("spawn")) as process:
        return process.submit(rate, name, config, episodes=episodes, **settings).result()


def main(
    policy: Annotated[str, typer.Argument(help=f"one of {', '.join(_POLICIES)}")] = "tiny",
    workers: Annotated[int, typer.Option(help="Workers of the rollouts.")] = 2,
    num_envs: Annotated[int, typer.Option(help="Environments of each worker.")] = 8,
    episodes: Annotated[int, typer.Option(help="Episodes of each way in each round.")] = 64,
    rounds: Annotated[int, typer.Option(help="Rounds.")] = 3,
    patience: Annotated[float, typer.Option(help="`batch.patience` of the server.")] = 0.5,
    size: Annotated[int, typer.Option(help="Pixels a side.")] = 224,
    images: Annotated[bool, typer.Option(help="Whether images are kept.")] = True,
    torchrl: Annotated[
        str,
        typer.Option(help="TorchRL's collector, too: 'grouped' in as many workers, or 'processes', one for each env."),
    ] = "",
) -> None:
    """Measure steps a second of each variant, and the ratios in each round."""
    if torchrl not in ("", "grouped", "processes"):
        raise typer.BadParameter(f"--torchrl: got {torchrl!r}, want 'grouped' or 'processes'")
    name, config = _POLICIES[policy]
    options = {"width": size, "height": size}
    agent = policy_class(name).from_config(config)
    agent.initialize()
    ratios: dict[str, list[float]] = {}

    def plain(episodes: int) -> float:
        return loop(agent, workers * num_envs, episodes, options, images=images)

    with contextlib.ExitStack() as stack:
        settings = {"workers": workers, "num_envs": num_envs}
        ways: dict[str, Callable[[int], float]] = {"loop": plain}
        if torchrl:
            ways["torchrl"] = partial(torchrl_rate, torchrl, policy, options=options, **settings)
        measure = stack.enter_context(served(name, config, patience, images=images, env_options=options, **settings))
        for _ in range(rounds):
            rates = {way: rate(episodes) for way, rate in ways.items()}
            ours = measure(episodes)
            for way, rate in rates.items():
                ratios.setdefault(way, []).append(ours / rate)
                out.print(f"{way} {rate:.0f} steps/s, rollouts {ours:.0f} steps/s: {ratios[way][-1]:.2f}")
    for way, found in ratios.items():
        out.print(f"median against {way} {statistics.median(found):.2f}")


if __name__ == "__main__":
    typer.run(main)
