"""Compares the steps per second of `Rollouts` with those of a plain loop over the same environments
and policy in one process, interleaved.

The loop is the simplest program of a learner: it steps environments one after another, calls the
policy once for all environments, and collects arrays. `Rollouts` steps as many environments in
workers, with a server whose batches may contain all of them. One environment is also stepped
without workers, in this process. With `--torchrl`, TorchRL's collector with its inference server is
also measured.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from typing import Annotated, Any, ClassVar

import numpy as np
import typer

from benchmarks.console import Out, parse_counts, save
from benchmarks.report import Outcome, show_outcomes
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.cli.options import parse_list
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.registry import policy_class
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray_learn import RolloutPlan, Rollouts

_POLICIES: dict[str, tuple[str, dict[str, Any]]] = {
    "tiny": ("benchmarks.rollouts:Tiny", {}),
    "slow": ("noop", {"action_dim": 4, "base_ms": 20, "per_item_ms": 1}),
}
LOOP, OURS, LOCAL = "loop", "rollouts", "without Ray"
# Minimum share of the loop's rate; 1 for all others.
_TARGETS = {("tiny", 1): 0.85, ("tiny", 16): 0.9, ("tiny", 64): 0.9}


class Tiny(Agent):
    """A policy with two layers of 64 units on the state of the tabletop."""

    shared: ClassVar[tuple[str, ...]] = ("layers",)

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=4))

    def initialize(self) -> None:
        rng = np.random.default_rng(0)
        self.layers = [
            rng.normal(0, size[0] ** -0.5, size).astype(np.float32)
            for size in ((7, 64), (64, 64), (64, 4))
        ]

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        rows = np.array([(*one.state["xyzrpy"], one.gripper) for one in obs], np.float32)
        for layer in self.layers:
            rows = np.tanh(rows @ layer)
        return [Act(row) for row in rows]


def loop(
    agent: Agent, num_envs: int, episodes: int, options: dict[str, Any], *, images: bool
) -> float:
    """Return the steps per second of `episodes` episodes in this process; their arrays are kept
    until all episodes have been run.
    """
    envs = [Tabletop(**options) for _ in range(num_envs)]
    seeds, steps, begun = itertools.count(), 0, time.perf_counter()
    collected: list[list[np.ndarray]] = []
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
        collected.append([np.stack(column) for column in zip(*rows, strict=True)])
    return steps / (time.perf_counter() - begun)


@dataclass(frozen=True, slots=True)
class RolloutComparison:
    """The settings of the comparison, whose programs are measured in turns."""

    policies: tuple[str, ...] = tuple(_POLICIES)
    envs: tuple[int, ...] = (1, 16, 64)  # numbers of environments of each program
    workers: int = 2  # maximum number of workers for all environments
    # Number of episodes of each program in each round, rounded up to a multiple of the
    # environments; a quarter of them if the program is slow.
    episodes: int = 64
    rounds: int = 3
    patience: float = 0.5  # `batch.patience` of the server
    size: int = 224  # width and height of images, pixels
    images: bool = True  # whether images are kept
    # "grouped" environments in as many workers, "processes" with one environment each, or ""
    # without TorchRL.
    torchrl: str = ""

    def __post_init__(self) -> None:
        if unknown := set(self.policies) - set(_POLICIES):
            raise ConfigError(f"policies: expected only {list(_POLICIES)}, got {sorted(unknown)}")
        if odd := [envs for envs in self.envs if envs % min(envs, self.workers)]:
            raise ConfigError(
                f"--envs: expected multiples of the {self.workers} workers, or 1, got {odd}"
            )
        if self.torchrl not in ("", "grouped", "processes"):
            raise ConfigError(f"--torchrl: expected 'grouped' or 'processes', got {self.torchrl!r}")

    @property
    def options(self) -> dict[str, int]:
        """The options of each environment."""
        return {"width": self.size, "height": self.size}

    def turn(self, policy: str, envs: int) -> int:
        """Return the number of episodes of a program in a round."""
        episodes = self.episodes if policy == "tiny" else self.episodes // 4
        return envs * math.ceil(episodes / envs)


def compare_rollouts(
    plan: RolloutComparison, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Measure each policy with each number of environments, and return plain JSON values."""
    rows = [_row(plan, policy, envs, progress) for policy in plan.policies for envs in plan.envs]
    return {"plan": asdict(plan), "cores": os.cpu_count(), "rows": rows}


def _row(
    plan: RolloutComparison, policy: str, envs: int, progress: Callable[[str], None]
) -> dict[str, Any]:
    name, config = _POLICIES[policy]
    make = partial(_made, name, config)
    agent, episodes = make(), plan.turn(policy, envs)
    agent.initialize()
    workers = min(envs, plan.workers)
    settings = {"workers": workers, "num_envs": envs // workers}
    kept = {"images": plan.images, "env_options": plan.options}
    ways: dict[str, Callable[[int], float]] = {
        LOOP: lambda number: loop(agent, envs, number, plan.options, images=plan.images)
    }
    if plan.torchrl:
        ways["torchrl"] = partial(
            torchrl_rate, plan.torchrl, policy, options=plan.options, **settings
        )
    with contextlib.ExitStack() as stack:
        ways[OURS] = stack.enter_context(served(name, config, plan.patience, **kept, **settings))
        if envs == 1:
            ways[LOCAL] = stack.enter_context(collecting(make, **kept, workers=0, num_envs=1))
        rounds = []
        for number in range(plan.rounds):
            rounds.append({way: rate(episodes) for way, rate in ways.items()})
            text = ", ".join(f"{way} {rate:.0f}" for way, rate in rounds[-1].items())
            progress(f"{policy}, {envs} envs, round {number + 1}/{plan.rounds}, steps/s: {text}")
    return {
        "policy": policy,
        "envs": envs,
        "workers": workers,
        "steps_per_s": {way: statistics.median(one[way] for one in rounds) for way in ways},
        "of_loop": {
            way: statistics.median(one[way] / one[LOOP] for one in rounds)
            for way in ways
            if way != LOOP
        },
        "rounds": rounds,
    }


def _made(name: str, config: Mapping[str, Any]) -> Agent:
    agent: Agent = policy_class(name).from_config(config)
    return agent


@contextlib.contextmanager
def served(
    policy: str, config: dict[str, Any], patience: float, **settings: Any
) -> Iterator[Callable[[int], float]]:
    """Serve the policy, and yield `collecting` with its server."""
    rows = settings["workers"] * settings["num_envs"]
    document = deployment(policy, config=config, batch={"patience": patience, "max_size": rows})
    with (
        running_server(document, num_cpus=settings["workers"] + 3, ingress=False),
        collecting(f"serve://{document.applications[0].name}", **settings) as measure,
    ):
        yield measure


@contextlib.contextmanager
def collecting(
    policy: str | Callable[[], Agent], **settings: Any
) -> Iterator[Callable[[int], float]]:
    """Yield a function that returns the steps per second of n episodes of `Rollouts` with these
    settings.
    """
    with Rollouts(RolloutPlan("tabletop", policy, **settings)) as rollouts:
        rollouts.collect(
            4 * max(1, settings["workers"]) * settings["num_envs"]
        )  # starts the workers, which make their environments

        def measure(episodes: int) -> float:
            begun = time.perf_counter()
            steps: int = rollouts.collect(episodes).num_rows
            return steps / (time.perf_counter() - begun)

        yield measure


def torchrl_rate(layout: str, policy: str, episodes: int, **settings: Any) -> float:
    """Return the steps per second of TorchRL's collector, measured in a new process by its function
    `rate`.
    """
    try:
        from benchmarks.torchrl_collector import rate
    except ModuleNotFoundError as error:
        raise typer.BadParameter(
            f"TorchRL is not installed ({error}): pip install torchrl"
        ) from error
    slow = policy == "slow"
    name, config = _POLICIES[policy]
    settings |= {"grouped": layout == "grouped", "whole_batches": slow, "images": slow}
    with ProcessPoolExecutor(1, get_context("spawn")) as process:
        return process.submit(rate, name, config, episodes=episodes, **settings).result()


def rollout_outcomes(found: Mapping[str, Any]) -> list[Outcome]:
    """Return the targets: for a tiny policy a share of the loop's rate, for a slow policy the whole
    rate.

    A single environment is judged by its rate without Ray, which is the recommended way to run it.
    """
    outcomes = []
    for row in found["rows"]:
        way = LOCAL if LOCAL in row["of_loop"] else OURS
        wanted, got = _TARGETS.get((row["policy"], row["envs"]), 1.0), row["of_loop"][way]
        who = "rollouts" if way == OURS else "rollouts without Ray"
        name = f"{who}, {row['envs']} environments, the {row['policy']} policy"
        outcomes.append(
            Outcome(name, f"≥ {wanted:g} x a loop in one process", f"{got:.2f}", got >= wanted)
        )
    return outcomes


def show_rollouts(found: Mapping[str, Any]) -> None:
    """Print a row for each policy and number of environments, and the targets."""
    plan = found["plan"]
    ways = list(dict.fromkeys(way for row in found["rows"] for way in row["steps_per_s"]))
    rows = table(
        "policy",
        "envs",
        "workers",
        *(f"{way}, steps/s" for way in ways),
        *(f"{way} / loop" for way in ways[1:]),
    )
    rows.title = (
        f"{plan['size']}x{plan['size']}, medians of {plan['rounds']} rounds on "
        f"{found['cores']} cores"
    )
    for row in found["rows"]:
        rates = (
            f"{row['steps_per_s'][way]:.0f}" if way in row["steps_per_s"] else "" for way in ways
        )
        shares = (f"{row['of_loop'][way]:.2f}" if way in row["of_loop"] else "" for way in ways[1:])
        rows.add_row(row["policy"], str(row["envs"]), str(row["workers"]), *rates, *shares)
    out.print(rows)
    show_outcomes(rollout_outcomes(found))


def main(
    policies: Annotated[str, typer.Option(help=f"Some of {', '.join(_POLICIES)}.")] = ",".join(
        _POLICIES
    ),
    envs: Annotated[str, typer.Option(help="Numbers of environments.")] = "1,16,64",
    workers: Annotated[
        int, typer.Option(min=1, help="Maximum number of workers of the rollouts.")
    ] = 2,
    episodes: Annotated[
        int,
        typer.Option(
            min=4,
            help="Number of episodes of each program in each round; a "
            "quarter of it for slow programs.",
        ),
    ] = 64,
    rounds: Annotated[int, typer.Option(min=1)] = 3,
    patience: Annotated[float, typer.Option(help="`batch.patience` of the server.")] = 0.5,
    size: Annotated[int, typer.Option(help="Width and height of images.")] = 224,
    images: Annotated[bool, typer.Option(help="Whether images are kept.")] = True,
    torchrl: Annotated[
        str,
        typer.Option(
            help="Also measure TorchRL's collector: 'grouped' in as many workers, or 'processes', "
            "one for each environment."
        ),
    ] = "",
    out_file: Out = None,
) -> None:
    """Measure steps per second of each program, as shares of the loop's rate."""
    with errors():
        plan = RolloutComparison(
            tuple(parse_list(policies)),
            tuple(parse_counts(envs, "--envs")),
            workers,
            episodes,
            rounds,
            patience,
            size,
            images,
            torchrl,
        )
        found = compare_rollouts(plan, progress)
    show_rollouts(found)
    save(found, out_file)


if __name__ == "__main__":
    typer.run(main)
