"""`vlagents-ray tune`: settings of a deployment file or a file of runs, measured on this machine."""

from __future__ import annotations

import datetime
import shlex
import sys
import time
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.cli.options import YAML_SUFFIXES, is_run_file, parse_dims, parse_list
from vlagents_ray.errors import ConfigError, MissingDependency

if TYPE_CHECKING:
    from vlagents_ray.bench.tuning.choice import MeasuredPoint


class Wanted(str, Enum):
    """What `--for` takes."""

    robots = "robots"
    throughput = "throughput"


def tune_command(
    file: Annotated[Path, typer.Argument(help="A deployment file, or a file of runs of `vlagents-ray eval`.")],
    wanted: Annotated[
        Wanted, typer.Option("--for", help="The most actions a second, or the most robots within --p99-ms.")
    ] = Wanted.throughput,
    p99_ms: Annotated[
        float | None, typer.Option("--p99-ms", min=0, help="Of robots: the longest round trip of 99 in 100, ms.")
    ] = None,
    out_file: Annotated[Path | None, typer.Option("--out", help="The tuned file; default: FILE.tuned.yaml.")] = None,
    minutes: Annotated[float, typer.Option(min=0.1, help="That all of it may take.")] = 5.0,
    max_workers: Annotated[
        int | None, typer.Option(min=1, help="Of a file of runs: the most workers to try; default: twice the cores.")
    ] = None,
    max_batch: Annotated[int, typer.Option(min=1, help="The largest batch to try.")] = 32,
    seconds: Annotated[float, typer.Option(min=0.1, help="Of each measurement.")] = 2.0,
    dtypes: Annotated[
        str | None,
        typer.Option(help="To try, as bfloat16,int8; default: the one that suits the accelerator, if any."),
    ] = None,
    tolerance: Annotated[
        float, typer.Option(min=0, help="How far actions may be off, as a share of their range.")
    ] = 0.01,
    frames: Annotated[
        Path | None, typer.Option(help="A folder of recorded trajectories to act on; default: random observations.")
    ] = None,
    app: Annotated[str | None, typer.Option(help="Of the file, if it holds several.")] = None,
    image: Annotated[int, typer.Option(min=1, help="Pixels a side, where the policy takes any image.")] = 224,
    state: Annotated[
        list[str], typer.Option(metavar="PART=N", help="Numbers in a part for which the policy does not say.")
    ] = [],  # noqa: B006
) -> None:
    """Find the best settings of a file by measuring, and write it with the figures.

    Of a deployment file: batch size, compilation and precision. Of a file of runs: workers, and environments a worker.
    """
    began = time.monotonic()
    from vlagents_ray.bench.tuning.choice import TuningGoal, choose, chosen_settings, default_point, figures
    from vlagents_ray.bench.tuning.picture import plot_latency
    from vlagents_ray.bench.tuning.tuner import TunePlan, Tuner
    from vlagents_ray.bench.tuning.yaml_text import with_comments, with_settings_in_text
    from vlagents_ray.cli.tune.evaluation import tune_evaluation
    from vlagents_ray.serve.config.deployment import ServerArgs
    from vlagents_ray.serve.launch.deployment_file import policy_application

    with errors():
        goal = TuningGoal(wanted.value, p99_ms)
        if file.suffix not in YAML_SUFFIXES:
            raise ConfigError(f"got {str(file)!r}, want a deployment file or a file of runs (.yaml)")
        where = out_file or file.with_suffix(f".tuned{file.suffix}")
        if is_run_file(file):
            if goal.kind != "throughput" or dtypes or frames or app or state:
                raise ConfigError(
                    "--for, --dtypes, --frames, --app and --state are of deployment files; leave them out"
                )
            tune_evaluation(file, where, minutes=minutes, max_workers=max_workers, began=began)
            return
        application = policy_application(str(file), app)
        args = ServerArgs(**application.args)
        plan = TunePlan(
            args, goal, max_batch, minutes, seconds, tolerance, None if dtypes is None else parse_list(dtypes), frames,
            image, parse_dims(state, "--state"),
        )  # fmt: skip
        tuner = Tuner(plan, progress, began)
        points = tuner.measure()
        _show(points, tuner.left_out, f"{args.policy} on {tuner.device}")
        chosen, default = choose(points, goal), default_point(points, goal, args.batch.max_size)
        text = with_settings_in_text(
            file.read_text(), application.name, chosen_settings(chosen, args.batch, tuner.fixed)
        )  # fmt: skip
        took = f"{time.monotonic() - began:.0f} s"
        lines = [f"chosen: {_words(chosen)}", f"the file as it was: {_words(default)}"]
        for line in lines:
            out.print(line)
        head = (
            f"Tuned on {datetime.date.today()} in {took} on {tuner.device}, by vlagents-ray {shlex.join(sys.argv[1:])}"
        )
        left_out = [f"left out: {sentence}" for sentence in tuner.left_out]
        where.write_text(with_comments(text, [head, *lines, *left_out], figures(points, chosen)))
        out.print(f"wrote {where}, after {took}")
        picture = where.with_suffix(".svg")
        try:
            plot_latency(points, chosen, default, goal, picture, f"{args.policy} on {tuner.device}")
        except MissingDependency as error:
            out.print(f"no picture of latency against throughput: {error}", style="yellow")
        else:
            out.print(f"wrote {picture}")


def _words(point: MeasuredPoint | None) -> str:
    if point is None:
        return "not measured, or out of the goal"
    from vlagents_ray.bench.tuning.choice import sessions

    figures = f"{point.actions_per_s:.1f} actions/s, p99 {point.p99_ms:.1f} ms"
    return f"{point.variant.name}, {sessions(point.sessions)}: {figures}"


def _show(points: Sequence[MeasuredPoint], left_out: Sequence[str], title: str) -> None:
    from vlagents_ray.bench.tuning.choice import figures

    [_, *head], *rows = figures(points, None)
    shown = table(*head, title=title)
    for row in rows:
        shown.add_row(*row[1:])
    out.print(shown)
    for sentence in left_out:
        out.print(f"left out: {sentence}", style="yellow")
