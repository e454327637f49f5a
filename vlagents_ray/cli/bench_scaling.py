"""The commands of `vlagents-ray bench` that show how workers and replicas scale."""

from __future__ import annotations

from typing import Annotated

import typer

from vlagents_ray.cli.console import errors, out, save, tell
from vlagents_ray.cli.options import Json, Plot
from vlagents_ray.cli.settings import parse_counts
from vlagents_ray.cli.tables import show_autoscaling, show_driver, show_scaling


def bench_scaling(
    workers: Annotated[str, typer.Option(help="Numbers of workers, ascending from 1.")] = "1,2,4,8,16",
    nodes: Annotated[str, typer.Option(help="Sizes of the clusters, of hosts that are made on this machine.")] = (
        "1,2,3"
    ),
    rounds: Annotated[int, typer.Option(min=1)] = 3,
    step_ms: Annotated[float, typer.Option(min=0, help="Each step of the environment sleeps so long.")] = 20.0,
    policy_ms: Annotated[float, typer.Option(min=0, help="And each batch of the policy.")] = 50.0,
    seconds: Annotated[float, typer.Option(min=0.1, help="That all workers play together, about.")] = 8.0,
    address: Annotated[
        str | None, typer.Option(help="A running Ray cluster in place of those hosts; they want root.")
    ] = None,
    json_file: Json = None,
) -> None:
    """Episodes a minute against the number of workers and nodes, and what the evaluation's driver costs."""
    from vlagents_ray.bench.scaling import ScalingPlan, measure_scaling

    with errors():
        plan = ScalingPlan(
            workers=tuple(parse_counts(workers, "--workers")), nodes=tuple(parse_counts(nodes, "--nodes")),
            rounds=rounds, step_ms=step_ms, policy_ms=policy_ms, seconds=seconds,
        )  # fmt: skip
        found = measure_scaling(plan, address, tell)
    show_scaling(found)
    show_driver(found["driver"])
    save(found, json_file)


def bench_autoscaling(
    robots: Annotated[int, typer.Option(min=1, help="That come at once.")] = 12,
    workers: Annotated[int, typer.Option(min=1, help="Of the evaluation that comes after them.")] = 8,
    seconds: Annotated[float, typer.Option(min=1, help="That each of the two stays, about.")] = 25.0,
    json_file: Json = None,
    plot: Plot = None,
) -> None:
    """Replicas over time while robots and rollouts come and go, from no replica and back to none."""
    from vlagents_ray.bench.autoscaling import AutoscalingPlan, measure_autoscaling
    from vlagents_ray.bench.plot import check, plot_autoscaling

    with errors():
        check(plot)
        found = measure_autoscaling(AutoscalingPlan(robots=robots, workers=workers, seconds=seconds), tell)
        show_autoscaling(found)
        save(found, json_file)
        if plot is not None:
            plot_autoscaling(found, plot)
            out.print(f"wrote {plot}", highlight=False)
