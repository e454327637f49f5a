"""The options of `vlagents-ray robot`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast, get_args

import typer

from vlagents_ray.chunking.buffer import Mode
from vlagents_ray.cli.console import errors
from vlagents_ray.cli.options import Set, parse_settings
from vlagents_ray.errors import ConfigError


def robot_command(
    env: Annotated[str, typer.Option(help="The environment: tabletop, maniskill/PickCube-v1, …")],
    policy: Annotated[
        str | None, typer.Argument(help="The URL of a server, a registered policy or 'module:Class'; default: a human.")
    ] = None,
    teleop: Annotated[
        str | None, typer.Option(help="What a human moves the robot with: keyboard or spacemouse.")
    ] = None,
    record: Annotated[Path | None, typer.Option(help="Record a LeRobotDataset v3.0 there, or continue it.")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="How many.")] = 10,
    seed: Annotated[int, typer.Option(help="Of the first episode; the others count on.")] = 0,
    hz: Annotated[float | None, typer.Option(help="Control rate; default: the environment's.")] = None,
    mode: Annotated[str, typer.Option(help=f"See ChunkPlayer: {', '.join(get_args(Mode))}.")] = "open_loop",
    execute: Annotated[int | None, typer.Option(min=1, help="Rows of a chunk to execute before asking again.")] = None,
    max_step: Annotated[
        float | None, typer.Option(min=0, help="Largest change of a number of the action from one tick to the next.")
    ] = None,
    step: Annotated[
        float | None, typer.Option(help="What an axis at its end adds at a tick; default: half of the action's bound.")
    ] = None,
    ask_for_help: Annotated[
        float | None, typer.Option(min=0, help="Pause where the policy's uncertainty is above this.")
    ] = None,
    samples: Annotated[int | None, typer.Option(min=2, help="Samples to compute the uncertainty from.")] = None,
    settings: Set = [],  # noqa: B006 - typer reads it
    env_options: Annotated[
        list[str], typer.Option("--env-set", metavar="KEY=VALUE", help="An option of the environment: width=256.")
    ] = [],  # noqa: B006
) -> None:
    """Drive a simulated robot: by a policy, by a human, or by a policy that a human corrects; record it if asked."""
    from vlagents_ray.cli.robot.run import RobotRun

    with errors():
        if ask_for_help is not None and teleop != "keyboard":
            raise ConfigError("--ask-for-help: got it without a way to answer, want --teleop keyboard")
        run = RobotRun(
            env=env,
            env_options=parse_settings(env_options, "--env-set"),
            policy=policy,
            settings=parse_settings(settings, "--set"),
            teleop=teleop,
            record=record,
            hz=hz,
            mode=cast("Mode", mode),  # which the player checks
            execute=execute,
            max_step=max_step,
            step=step,
            ask_for_help=ask_for_help,
            samples=samples,
        )
        try:
            run.play(range(seed, seed + episodes))
        except KeyboardInterrupt:
            kept = "" if run.recorder is None else f"; {run.recorder.episodes} episodes are in {run.record}"
            raise KeyboardInterrupt(f"interrupted{kept}") from None
