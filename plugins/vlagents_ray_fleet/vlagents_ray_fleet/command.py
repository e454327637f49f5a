"""`vlagents-ray plan`: the replicas and GPUs that a fleet of robots needs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlagents_ray.cli.console import errors, fail, out, print_json, table
from vlagents_ray.cli.options import AsJson, ConfigDir, SetInFile, finite
from vlagents_ray.overrides import find_file, parse_overrides

if TYPE_CHECKING:
    from vlagents_ray_fleet.check import Check
    from vlagents_ray_fleet.plan import FleetPlan


def plan_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The file of the fleet (.yaml).")],
    out_file: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Write the plan as a deployment file."),
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Simulate the plan, and compare the results with the prediction."
        ),
    ] = False,
    seconds: Annotated[
        float,
        typer.Option(
            min=1,
            max=86_400,
            callback=finite,
            metavar="S",
            help="With --check: simulated time in seconds.",
        ),
    ] = 60.0,
    seed: Annotated[
        int,
        typer.Option(
            min=0, max=2**32 - 1, metavar="N", help="With --check: seed of the simulation."
        ),
    ] = 0,
    settings: SetInFile = [],  # noqa: B006
    config_dir: ConfigDir = None,
    as_json: AsJson = False,
) -> None:
    """Compute the replicas, batch sizes and GPUs with which all robots of a fleet receive their
    actions in time.
    """
    # Imported late, so that the help of the command line is fast.
    from vlagents_ray_fleet.check import check as run_check
    from vlagents_ray_fleet.deployment import deployment_document, write_deployment
    from vlagents_ray_fleet.fleet_file import read_fleet
    from vlagents_ray_fleet.plan import plan as compute_plan

    with errors():
        path = Path(find_file(str(file), config_dir))
        fleet = read_fleet(path, parse_overrides(settings, "--set"))
        plan = compute_plan(fleet)
        if out_file is not None:
            document = deployment_document(fleet, plan, path.parent)
            write_deployment(document, out_file, path.name)
        checked = run_check(plan, seconds, seed) if check else None

        if as_json:
            document = plan.document()
            if checked is not None:
                document["check"] = asdict(checked)
            print_json(document)
        else:
            _print_plan(plan)
            if checked is not None:
                _print_check(checked)
            if out_file is not None:
                out.print(f"vlagents-ray serve {out_file}")
        if not plan.is_complete:
            served = sum(plan.robots.values())
            wanted = sum(plan.robots_wanted.values())
            missing = plan.gpus_needed - plan.gpus_at_hand
            fail(
                f"{plan.gpus_at_hand} GPUs serve {served} of {wanted} robots in time; all robots "
                f"need {plan.gpus_needed} GPUs, {missing} more",
                1,
            )


def _print_plan(plan: FleetPlan) -> None:
    models = table("model", "replicas", "GPU of each", "batch", "load", "answer ms")
    groups = table(
        "model", "robots", "rows at Hz", "share", "target", "replan ms", "slack ms", "age p95 ms"
    )
    for model in plan.models:
        models.add_row(
            model.model,
            str(model.replicas),
            f"{model.gpu_fraction:g}",
            str(model.batch_size),
            f"{model.load:.2f}",
            f"{model.latency_ms:.0f}",
        )
        for group in model.groups:
            age = "" if group.target_age_ms is None else f" of {group.target_age_ms:.0f}"
            groups.add_row(
                model.model,
                f"{group.robots} {group.group}",
                f"{group.rows} at {group.hz:g}",
                f"{group.share:.3f}",
                f"{group.target_share:.3f}",
                f"{group.replan_ms:.0f}",
                f"{group.slack_ms:.0f}",
                f"{group.age_p95_ms:.0f}{age}",
            )
    out.print(models)
    out.print(groups)
    for layout, count in plan.gpus:
        held = [
            f"{replicas} x {piece.model} ({piece.parts / plan.parts:g} of the GPU each)"
            for piece, replicas in layout.pieces
        ]
        out.print(f"{count} GPU{'s' * (count > 1)} with {', '.join(held)}")
    out.print(f"{plan.gpus_used} of {plan.gpus_at_hand} GPUs")
    if any(model.gpu_fraction < 1 for model in plan.models):
        out.print("assumed: a batch on a fraction f of a GPU takes 1/f of its time on a whole one")


def _print_check(checked: Check) -> None:
    results = table(
        "model",
        "robots",
        "in time",
        "share",
        "predicted",
        "age p95 ms",
        "predicted",
        title=f"simulated {checked.simulated_s:g} s, {checked.requests} requests",
    )
    for group in checked.groups:
        results.add_row(
            group.model,
            group.group,
            f"{group.robots_in_time} of {group.robots}",
            f"{group.share:.4f}",
            f"{group.predicted_share:.4f}",
            f"{group.age_p95_ms:.0f}",
            f"{group.predicted_age_p95_ms:.0f}",
        )
    out.print(results)
