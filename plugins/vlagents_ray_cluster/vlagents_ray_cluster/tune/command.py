"""`vlagents-ray tune`: settings of a deployment file, measured on this machine."""

from __future__ import annotations

import time
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.cli.options import (
    ConfigDir,
    ServeSet,
    Set,
    StateDims,
    find_policy,
    finite,
    parse_dims,
    parse_list,
    policy_overrides,
)
from vlagents_ray.errors import ConfigError
from vlagents_ray.overrides import YAML_SUFFIXES

if TYPE_CHECKING:
    from vlagents_ray_cluster.tune.tuner import MeasuredPoint


class Goal(str, Enum):
    """The values of `--for`."""

    robots = "robots"
    throughput = "throughput"


def tune_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A deployment file.")],
    goal: Annotated[
        Goal,
        typer.Option(
            "--for",
            metavar="throughput|robots",
            help="The goal: most actions per second, or most robots within --p99-ms.",
        ),
    ] = Goal.throughput,
    p99_ms: Annotated[
        float | None,
        typer.Option(
            "--p99-ms",
            min=0,
            max=1e6,
            callback=finite,
            metavar="MS",
            help="With --for robots: the largest 99th percentile of the latency, in ms.",
        ),
    ] = None,
    minutes: Annotated[
        float,
        typer.Option(
            min=0.1,
            max=10_000,
            callback=finite,
            metavar="N",
            help="Longest time of the search, in minutes.",
        ),
    ] = 5.0,
    max_batch: Annotated[
        int, typer.Option(min=1, max=10_000, metavar="N", help="Largest batch that is tried.")
    ] = 32,
    seconds: Annotated[
        float,
        typer.Option(
            min=0.1,
            max=3600,
            callback=finite,
            metavar="S",
            help="Length of each measurement, in seconds.",
        ),
    ] = 2.0,
    dtypes: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Types of numbers that are tried, such as bfloat16,int8; default: those of the "
            "accelerator.",
        ),
    ] = None,
    tolerance: Annotated[
        float,
        typer.Option(
            min=0,
            max=1,
            callback=finite,
            metavar="SHARE",
            help="Largest deviation of an action, as a share of its range.",
        ),
    ] = 0.01,
    frames: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="Recorded trajectories whose observations are used; default: random observations.",
        ),
    ] = None,
    app: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Application of the file, if it contains several."),
    ] = None,
    image: Annotated[
        int,
        typer.Option(
            min=1,
            max=8192,
            metavar="N",
            help="Width and height of random images in pixels, if the policy accepts any size.",
        ),
    ] = 224,
    state: StateDims = [],  # noqa: B006
    settings: Set = [],  # noqa: B006
    serve_settings: ServeSet = [],  # noqa: B006
    config_dir: ConfigDir = None,
) -> None:
    """Find the best batch size, compilation and precision by measuring, and print the settings
    to change.
    """
    began = time.monotonic()
    # Imported late, so that the help of the command line is fast.
    from vlagents_ray.serve.config.deployment import ServerArgs
    from vlagents_ray.serve.launch.deployment_file import policy_application
    from vlagents_ray_cluster.tune.tuner import (
        TunePlan,
        Tuner,
        TuningGoal,
        choose,
        chosen_settings,
        default_point,
        figures,
    )

    with errors():
        tuning_goal = TuningGoal(goal.value, p99_ms)
        deployment_file = find_policy(str(file), config_dir)
        if not deployment_file.endswith(YAML_SUFFIXES):
            raise ConfigError(f"expected a deployment file (.yaml), got {str(file)!r}")
        overrides = policy_overrides(settings, serve_settings)
        application = policy_application(deployment_file, app, overrides)
        args = ServerArgs(**application.args)
        plan = TunePlan(
            args=args,
            goal=tuning_goal,
            max_batch=max_batch,
            minutes=minutes,
            seconds=seconds,
            tolerance=tolerance,
            dtypes=None if dtypes is None else parse_list(dtypes),
            frames=frames,
            side=image,
            dims=parse_dims(state, "--state-dim"),
        )
        tuner = Tuner(plan, progress, began)
        points = tuner.measure()

        head, *rows = figures(points)
        table_of_points = table(*head, title=f"{args.policy} on {tuner.device}")
        for row in rows:
            table_of_points.add_row(*row)
        out.print(table_of_points)
        for sentence in tuner.left_out:
            out.print(f"left out: {sentence}", style="yellow")

        chosen = choose(points, tuning_goal)
        default = default_point(points, tuning_goal, args.batch.max_size)
        out.print(f"chosen: {_words(chosen)}\nthe file as it is: {_words(default)}")
        out.print(f"after {time.monotonic() - began:.0f} s")
        better_settings = chosen_settings(chosen, args.batch, tuner.fixed)
        if better_settings:
            import yaml

            text = yaml.safe_dump(better_settings, sort_keys=False, default_flow_style=None)
            out.print(f"set below args of {application.name!r} in {deployment_file}:\n\n{text}")
        else:
            out.print("nothing to change")


def _words(point: MeasuredPoint | None) -> str:
    """Return a point and its figures in words."""
    if point is None:
        return "not measured, or does not reach the goal"
    from vlagents_ray_cluster.tune.tuner import sessions

    figures = f"{point.actions_per_s:.1f} actions/s, p99 {point.p99_ms:.1f} ms"
    return f"{point.variant.name}, {sessions(point.sessions)}: {figures}"
