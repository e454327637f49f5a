"""The tables of `vlagents-ray bench`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.markup import escape
from rich.table import Table

from vlagents_ray.bench.targets import Outcome, evaluation_outcomes, soak_outcomes
from vlagents_ray.cli.console import out

if TYPE_CHECKING:
    from vlagents_ray.bench.overhead import Overhead


def show_overhead(found: Overhead) -> None:
    """A row for each round."""
    table = Table("round", "bare steps/s", "evaluated steps/s", "ratio", "bare CPU ms/step", "evaluated CPU ms/step")
    table.title = f"{found.env}, {found.workers} workers"
    for number, (bare, ours, ratio) in enumerate(zip(found.bare, found.evaluated, found.ratios, strict=True), 1):
        table.add_row(
            str(number), f"{bare.steps_per_s:.1f}", f"{ours.steps_per_s:.1f}", f"{ratio:.3f}",
            f"{bare.cpu_ms_per_step:.3f}", f"{ours.cpu_ms_per_step:.3f}",
        )  # fmt: skip
    out.print(table)


def show_round_trips(found: Mapping[str, Any], title: str) -> None:
    """A row for each way, the fastest first; beside ours, the ratios to the peers."""
    theirs = [peer["way"] for peer in found["peers"]]
    table = Table("way", "median ms", "95 % interval", "p99 ms", *(f"/ {name}" for name in theirs))
    table.title = f"{title}: two 224x224 RGB cameras, no-op policy"
    for row in sorted([*found["ways"], *found["peers"]], key=lambda one: float(one["median_ms"])):
        low, high = row["ci95_ms"]
        ratios = found["ratios"].get(row["way"], {})
        cells = []
        for name in theirs:
            one = ratios.get(name)
            cells.append(f"{one['ratio']:.2f} ({one['ci95'][0]:.2f}-{one['ci95'][1]:.2f})" if one else "")
        table.add_row(
            row["way"], f"{row['median_ms']:.3f}", f"{low:.3f} to {high:.3f}", f"{row['p99_ms']:.3f}", *cells,
            style="dim" if row["way"] in theirs else None,
        )  # fmt: skip
    out.print(table)
    show_skipped(found)


def show_policy(found: Mapping[str, Any]) -> None:
    """A row for each batch size."""
    table = Table(
        "batch", "bare actions/s", "ms a batch", "queued actions/s", "round trip ms", "mean batch", "peak MiB"
    )
    rows = f", {found['chunk']} rows an action" if (found["chunk"] or 1) > 1 else ""
    table.title = f"{found['policy']} on {found['device']}{rows}"
    for row in found["batches"]:
        bare, queued = row["bare"], row["queued"]
        table.add_row(
            str(row["batch"]), f"{bare['actions_per_s']:.1f}", f"{bare['batch_ms']:.2f}",
            f"{queued['actions_per_s']:.1f}", f"{queued['round_trip_ms']:.2f}", f"{queued['mean_batch']:.2f}",
            f"{row['peak_mib']:.0f}",
        )  # fmt: skip
    out.print(table)


def show_throughput(found: Mapping[str, Any]) -> None:
    """A row for each number of clients, and a sentence for each transport."""
    table = Table("transport", "clients", "actions/s", "of ideal", "mean batch", "p50 ms", "p99 ms")
    table.title = f"{found['policy']}, ideal {found['ideal_actions_per_s']:.0f} actions/s ({found['ideal_is']})"
    for name, row in found["transports"].items():
        for point in row["curve"]:
            numbers = [point[key] for key in ("of_ideal", "mean_batch", "p50_ms", "p99_ms")]
            cells = ["" if number is None else f"{number:.3g}" for number in numbers]
            table.add_row(name, str(point["clients"]), f"{point['actions_per_s']:.1f}", *cells)
        table.add_section()
    out.print(table)
    for name, row in found["transports"].items():
        robot = row["robot"]
        waits = (
            f"; a robot among simulations waits {robot['wait_p50_ms']:.1f} ms (p99 {robot['wait_p99_ms']:.1f})"
            if robot
            else ""
        )
        out.print(
            f"{name}: {row['actions_per_s']:.1f} actions/s, {row['of_ideal']:.3f} of the ideal{waits}", highlight=False
        )
    show_skipped(found)


def show_evaluation(found: Mapping[str, Any]) -> None:
    """A row for each system, and the targets."""
    plan = found["plan"]
    table = Table("", "episodes/min", "whole command s", "ours / theirs", "wall: theirs / ours")
    table.title = (
        f"{plan['episodes']} episodes of {plan['max_steps']} steps, {plan['size']}x{plan['size']}, "
        f"{plan['workers']} workers on {found['cores']} cores, medians of {plan['rounds']} rounds"
    )
    for name, row in found["medians"].items():
        ratio = found["ratios"].get(name)
        cells = [f"{ratio['median']:.2f}", f"{ratio['wall_median']:.2f}"] if ratio else ["", ""]
        table.add_row(name, f"{row['episodes_per_minute']:.0f}", f"{row['wall_s']:.1f}", *cells)
    out.print(table)
    show_outcomes(evaluation_outcomes(found))
    show_skipped(found)


def show_soak(found: Mapping[str, Any]) -> None:
    """What was counted, and the verdict."""
    out.print(
        f"{found['plan']['episodes']} episodes, {found['episodes_per_minute']:.0f} a minute; workers killed: "
        f"{found['killed']}, retries: {found['retries']}, played again: {found['played_again']}",
        highlight=False,
    )
    show_outcomes(soak_outcomes(found))


def show_scaling(found: Mapping[str, Any]) -> None:
    """A row for each number of workers on each cluster."""
    plan = found["plan"]
    table = Table("nodes", "workers", "replicas", "episodes/min", "of linear", "of ideal", "whole run s", "by")
    table.title = (
        f"{plan['steps']} steps of {plan['step_ms']:g} ms, policy {plan['policy_ms']:g} ms, "
        f"medians of {plan['rounds']} rounds on {found['cores']} cores"
    )
    for cluster in found["clusters"]:
        for row in cluster["rows"]:
            counts = (str(cluster["nodes"]), str(row["workers"]), row["app"], f"{row['episodes_per_minute']:.1f}")
            ratios = (f"{row['of_linear']:.3f}", f"{row['of_ideal']:.3f}", f"{row['wall_s']:.1f}")
            table.add_row(*counts, *ratios, ", ".join(row["transports"]))
        table.add_section()
    out.print(table)


def show_driver(found: Mapping[str, Any]) -> None:
    """What a driver costs, and how many workers it has time for."""
    costs, flooded = found["costs_ms"], found["flooded"]
    out.print(
        f"the driver's CPU time: {costs['episode']:.2f} ms an episode, {costs['step'] * 1e3:.1f} µs a step, "
        f"{costs['worker_second']:.2f} ms a second for each worker, {costs['second']:.1f} ms a second at all\n"
        f"flooded by {flooded['workers']} workers: {flooded['episodes_per_s']:.0f} episodes/s, "
        f"{flooded['driver_ms_per_episode']:.2f} ms each, {100 * flooded['driver_share']:.0f} % of a core",
        highlight=False,
    )
    for seconds, workers in found["saturated_workers"].items():
        out.print(f"episodes of {seconds} s: one driver is saturated by {workers:.0f} workers", highlight=False)


def show_autoscaling(found: Mapping[str, Any]) -> None:
    """A row for each who came."""
    table = Table("", "first reset s", "replicas", "acts", "failed", "begun again", "median ms", "p95 ms", "longest")
    for one in found["phases"]:
        waited = "" if one["first_reset_s"] is None else f"{one['first_reset_s']:.1f}"
        table.add_row(
            one["name"], waited, str(one["most_replicas"]), str(one["acts"]), str(len(one["failed"])),
            str(one["resumed"]), *(f"{one[key]:.1f}" for key in ("median_ms", "p95_ms", "longest_ms")),
        )  # fmt: skip
    out.print(table)


def show_outcomes(lines: Sequence[Outcome]) -> None:
    """Targets, and whether they are met."""
    if not lines:
        return
    table = Table("", "wanted", "measured", "met")
    for one in lines:
        table.add_row(one.what, one.wanted, one.measured, {True: "yes", False: "[red]no[/]", None: ""}[one.met])
    out.print(table)


def show_skipped(found: Mapping[str, Any]) -> None:
    """What could not be measured, and why."""
    for name, reason in found["skipped"].items():
        out.print(f"[yellow]skipped {escape(name)}[/]: {escape(reason)}", highlight=False, soft_wrap=True)
