"""Record an expert's corrections of the reference policy, or only the expert's demonstrations.

Options: `python examples/reference/dagger.py record --help`, and `demonstrate --help`.

The policy controls the tabletop until the expert takes over, at the first tick with an open gripper
after a random tick, so that nothing is dropped. The expert's actions then begin in states that the
policy reaches (DAgger, arXiv 1011.0686; with an expert that takes over: HG-DAgger, arXiv
1810.02890). Episodes that the policy solves before the takeover are not recorded.

With `--delay`, the policy's answers are late, and an expert that continues from any state takes
over several times in an episode, each time at the tick at which an answer would have arrived. So
the recording shows how to continue the rows that the robot executes while it waits.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from reactive import expert_action

from vlagents_ray.datasets.writer import Dataset
from vlagents_ray.envs import EvalEnv, make_env
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.evaluate import Results, compare
from vlagents_ray.evaluate.episode.latency import ChunkExecutor
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.interface import Act
from vlagents_ray.policies.experts.tabletop import TabletopExpert
from vlagents_ray.policies.reference import Reference

TAKE_OVER = 20  # ticks within which the expert may take over; a successful episode has 31
OPEN = 0.9  # opening of a gripper that holds nothing
EXECUTE = 4  # executed rows of a chunk, as in the evaluation
# With `--delay`: the share of the answers that the expert replaces, and the number of ticks that it
# drives then, from the first to below the second.
REPLACED, LEADS = 0.5, (4, 12)
# With `--delay`: the noise of some of the policy's and the expert's actions, in units of an action.
# The same noise is in the recorded actions, so that it is a part of the rows that are continued.
NOISE, NOISY = 0.3, 0.15
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


def correct_late(env: EvalEnv, policy: Reference, dataset: Dataset, seed: int, delay: int) -> bool:
    """Run an episode in which answers arrive `delay` ticks after their observation. Return whether
    it was kept, because the expert drove at some tick.
    """
    obs, _ = env.reset(seed=seed)
    policy.reset(obs, env.instruction, seed=seed)
    rng, hz = np.random.default_rng(seed), env.contract.control_hz or HZ
    clock = ClockConfig(latency=delay / hz, mode="async", real_time_chunking=True, fresh_grip=None)
    episode = dataset.begin(env.instruction, env.contract.action)
    executor, last = ChunkExecutor(EXECUTE, clock, env.contract), None
    ticks, frames, led, solved = 0, 0, False, False

    def execute(action: np.ndarray, *, leads: bool = False, waits: bool = False) -> bool:
        """Execute an action, and record it unless the robot waits without rows; return whether the
        episode goes on.
        """
        nonlocal obs, ticks, frames, last, solved
        if not waits:
            episode.add(obs, action, frames / HZ, frames, False, leads)
            frames += 1
        obs, _, _, _, info = env.step(Act(action))
        ticks, last, solved = ticks + 1, action, bool(info["success"])
        return not solved and ticks < env.max_steps

    goes_on = True
    while goes_on:
        act = policy.act(replace(obs, info=executor.request_info()))
        takes_over = rng.random() < REPLACED
        for tick in executor.ticks(act.rows(), delay / hz, act.info):
            if takes_over and not tick.waited:
                break
            action = tick.action.copy()
            if tick.waited and not tick.starved and rng.random() < NOISY:
                action[:3] = np.clip(action[:3] + rng.normal(0.0, NOISE, 3), -1, 1)
            goes_on = execute(action, waits=tick.starved)
            if not goes_on:
                break
        if not (takes_over and goes_on):
            continue
        led = True
        for _ in range(rng.integers(*LEADS)):
            goes_on = execute(expert_action(obs, env.instruction), leads=True)
            if not goes_on:
                break
        executor = ChunkExecutor(EXECUTE, clock, env.contract, last)

    if led:
        dataset.save(episode.finish("success" if solved else "failure"))
    else:
        episode.abandon()
    return led


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
    delay: Annotated[
        int, typer.Option(min=0, help="Largest delay of an answer, ticks; each episode draws one.")
    ] = 0,
) -> None:
    """Record corrections, without loss, since the policy receives images without loss."""
    policy = Reference.from_config(
        {
            "checkpoint": str(checkpoint),
            "embodiment": "tabletop",
            # A late answer needs rows beyond those that are executed next.
            "execute": None if delay else EXECUTE,
        }
    )
    policy.initialize()
    begun = time.monotonic()
    options = {"cameras": ["front", "wrist"], "width": 64, "height": 64}
    with make_env("tabletop", **options, object_state=delay > 0) as env:
        dataset = Dataset(out, HZ, interventions=True, lossless=True, durable=False)
        kept = 0
        for number in range(seed, seed + episodes):
            if delay:
                kept += correct_late(env, policy, dataset, number, 1 + number % delay)
            else:
                kept += correct(env, policy, dataset, number)
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
