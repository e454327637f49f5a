"""Record an expert's corrections of the reference policy, or only the expert's demonstrations.

Options: `python examples/reference/dagger.py record --help`, and `demonstrate --help`.

The policy controls the tabletop until the expert takes over, at the first tick with an open gripper
after a random tick, so that nothing is dropped. The expert's actions then begin in states that the
policy reaches (DAgger, arXiv 1011.0686; with an expert that takes over: HG-DAgger, arXiv
1810.02890). Episodes that the policy solves before the takeover are not recorded.
"""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from vlagents_ray.datasets.writer import Dataset
from vlagents_ray.envs import EvalEnv, make_env
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.evaluate import Results, compare
from vlagents_ray.interface import Act
from vlagents_ray.policies.experts.tabletop import TabletopExpert
from vlagents_ray.policies.reference import Reference

TAKE_OVER = 20  # ticks within which the expert may take over; a successful episode has 31
OPEN = 0.9  # opening of a gripper that holds nothing
EXECUTE = 4  # executed rows of a chunk, as in the evaluation
HZ = 20  # rate of the tabletop
# Disturbances of the demonstrations, in alternation, as in demonstrations/tabletop.yaml.
DISTURBANCES = (0.5, 1.0)
app = typer.Typer(pretty_exceptions_enable=False)


def correct(env: EvalEnv, policy: Reference, dataset: Dataset, seed: int) -> bool:
    """Run an episode, and keep it if the expert solved it. Return whether the episode was kept."""
    obs, _ = env.reset(seed=seed)
    policy.reset(obs, env.instruction, seed=seed)
    expert, due, rows = (
        TabletopExpert("tabletop"),
        np.random.default_rng(seed).integers(TAKE_OVER),
        np.zeros((0, 4)),
    )
    episode, led, solved = dataset.begin(env.instruction, env.contract.action), False, False
    for tick in range(env.max_steps):
        if not led and tick >= due and (obs.gripper or 0.0) > OPEN:
            # The gripper hides an object; the policy continues.
            with contextlib.suppress(InvalidObservation):
                expert.reset(obs, env.instruction)
                led = True
        if led:
            try:
                action = expert.act(obs).action
            except InvalidObservation:
                break
        else:
            rows = rows if len(rows) else policy.act(obs).rows()
            action, rows = rows[0], rows[1:]
        episode.add(obs, action, tick / HZ, tick, False, led)
        obs, _, _, _, info = env.step(Act(action))
        if solved := bool(info["success"]):
            break
    if led and solved:
        dataset.save(episode.finish("success"))
    else:
        episode.abandon()
    return led and solved


def demonstrate_episode(env: EvalEnv, dataset: Dataset, seed: int) -> bool:
    """Run an episode of the expert alone, and keep it if the task was solved.

    Returns:
        Whether it was kept.
    """
    obs, _ = env.reset(seed=seed)
    expert = TabletopExpert("tabletop")
    expert.reset(obs, env.instruction)
    episode = dataset.begin(env.instruction, env.contract.action)
    solved = False

    for tick in range(env.max_steps):
        try:
            action = expert.act(obs).action
        except InvalidObservation:  # The gripper hides an object.
            break
        episode.add(obs, action, tick / HZ, tick, False)
        obs, _, _, _, info = env.step(Act(action))
        solved = bool(info["success"])
        if solved:
            break

    if solved:
        dataset.save(episode.finish())
    else:
        episode.abandon()
    return solved


@app.command()
def record(
    checkpoint: Annotated[Path, typer.Argument(help="Of the policy.")],
    out: Annotated[Path, typer.Argument(help="New folder of a LeRobotDataset with interventions.")],
    episodes: Annotated[int, typer.Option(min=1, help="That are played.")] = 800,
    seed: Annotated[
        int, typer.Option(help="Seed of the first episode; seeds of the evaluation begin at 0.")
    ] = 2_000_000,
) -> None:
    """Record corrections, without loss, since the policy receives images without loss."""
    policy = Reference.from_config(
        {"checkpoint": str(checkpoint), "embodiment": "tabletop", "execute": EXECUTE}
    )
    policy.initialize()
    begun = time.monotonic()
    with make_env("tabletop", cameras=["front", "wrist"], width=64, height=64) as env:
        dataset = Dataset(out, HZ, interventions=True, lossless=True, durable=False)
        kept = sum(correct(env, policy, dataset, number) for number in range(seed, seed + episodes))
    typer.echo(f"{kept} of {episodes} episodes corrected, in {time.monotonic() - begun:.0f} s")


@app.command()
def demonstrate(
    out: Annotated[Path, typer.Argument(help="New folder of a LeRobotDataset.")],
    episodes: Annotated[int, typer.Option(min=1, help="Number of episodes that are run.")] = 800,
    seed: Annotated[
        int, typer.Option(help="Seed of the first episode; seeds of the evaluation begin at 0.")
    ] = 3_000_000,
    lossless: Annotated[
        bool,
        typer.Option(
            help="Keep each pixel. The default is H.264, which is lossy, as in usual datasets."
        ),
    ] = True,
) -> None:
    """Record demonstrations of the expert, with disturbances as in the first training."""
    begun = time.monotonic()
    kept = 0
    dataset = Dataset(out, HZ, lossless=lossless, durable=False)
    with contextlib.ExitStack() as stack:
        envs = [
            stack.enter_context(
                make_env(
                    "tabletop",
                    cameras=["front", "wrist"],
                    width=64,
                    height=64,
                    disturbance=disturbance,
                )
            )
            for disturbance in DISTURBANCES
        ]
        for number in range(episodes):
            env = envs[number % len(envs)]
            kept += demonstrate_episode(env, dataset, seed + number)
    typer.echo(f"{kept} of {episodes} episodes solved, in {time.monotonic() - begun:.0f} s")


@app.command("compare")
def compare_after(
    out: Annotated[
        Path, typer.Argument(help="Results before and after the training, on the same seeds.")
    ],
) -> None:
    """Print the paired comparison of an evaluation, with McNemar's exact test."""
    total = compare(Results.load(out), "after", "before").total
    pairs, (low, high) = total.pairs, total.interval
    typer.echo(
        f"solved after only {pairs.only_a}, before only {pairs.only_b}, both {pairs.both} of "
        f"{pairs.total}"
    )
    typer.echo(
        f"difference {pairs.difference:+.1%} [{low:+.1%}, {high:+.1%}], p {total.p_value:.2g}"
    )


if __name__ == "__main__":
    app()
