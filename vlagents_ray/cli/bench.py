"""`vlagents-ray bench`: measurements that users can repeat on their own machines."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from vlagents_ray.cli.console import errors, out, progress, save, table
from vlagents_ray.cli.options import Set, StateDims, parse_counts, parse_dims, parse_list, parse_settings
from vlagents_ray.errors import ConfigError

if TYPE_CHECKING:
    from vlagents_ray.bench.throughput import ThroughputPlan

bench = typer.Typer(no_args_is_help=True, help="Measure transports and policies on this machine.")

# Options that several commands have.
Calls = Annotated[int, typer.Option(min=1, help="Round trips by each way.")]
Seconds = Annotated[float, typer.Option(min=0.1, help="Of each measurement.")]
Rounds = Annotated[int, typer.Option(min=1)]
Json = Annotated[Path | None, typer.Option("--json", help="Write the figures here.")]
Transports = Annotated[str, typer.Option(help="shm,websocket,http,handle,plasma; default: all.")]


@bench.command("rtt")
def bench_rtt(calls: Calls = 1000, transports: Transports = "", json_file: Json = None) -> None:
    """Round trips to a `noop` policy on this machine by every transport, in turns."""
    from vlagents_ray.bench.figures import measured_on
    from vlagents_ray.bench.rtt import measure_rtt

    with errors():
        origin = measured_on()
        found = measure_rtt(calls, transports=parse_list(transports), progress=progress).to_json()
        show_round_trips(found, "round trip of one act on this machine")
        save({**origin, **found}, json_file)


@bench.command("throughput")
def bench_throughput(
    transports: Annotated[str, typer.Option(help="With commas between them.")] = "plasma,handle,shm,websocket",
    clients: Annotated[str, typer.Option(help="Numbers; the largest is compared with the ideal.")] = "1,2,4,8,16,32",
    batch: Annotated[int, typer.Option(min=1, help="Observations in one forward pass, at most.")] = 16,
    seconds: Seconds = 2.0,
    rounds: Rounds = 3,
    robot_seconds: Annotated[float, typer.Option(min=0, help="How long a robot is watched; 0: not at all.")] = 10.0,
    policy: Annotated[str | None, typer.Option(help="Default: noop, 20 ms + 1 ms an observation.")] = None,
    settings: Set = [],  # noqa: B006
    num_gpus: Annotated[float, typer.Option(min=0, help="That Ray gives to the replica.")] = 0.0,
    json_file: Json = None,
) -> None:
    """Actions a second of many clients on one replica, against the ideal, or the bare policy in the same run."""
    from vlagents_ray.bench.figures import measured_on
    from vlagents_ray.bench.throughput import ThroughputPlan, measure_throughput

    with errors():
        origin = measured_on()
        if settings and policy is None:
            raise ConfigError("--set: is for --policy; name one")
        chosen: dict[str, Any] = (
            {} if policy is None else {"policy": policy, "config": parse_settings(settings, "--set")}
        )
        counts = parse_counts(clients, "--clients")
        plan: ThroughputPlan = ThroughputPlan(
            **chosen, num_gpus=num_gpus, batch=batch, clients=counts, seconds=seconds, rounds=rounds,
            robot_seconds=robot_seconds, transports=parse_list(transports),
        )  # fmt: skip
        found = measure_throughput(plan, progress)
    show_throughput(found)
    save({**origin, **found}, json_file)


@bench.command("policy")
def bench_policy(
    file: Annotated[str, typer.Argument(help="A deployment file, or a registered policy.")],
    batch: Annotated[str, typer.Option(help="Batch sizes, with commas between them.")] = "1,8",
    seconds: Seconds = 2.0,
    rounds: Rounds = 3,
    app: Annotated[str | None, typer.Option(help="Of the file, if it holds several.")] = None,
    image: Annotated[int, typer.Option(min=1, help="Pixels a side, where the policy takes any image.")] = 224,
    state: StateDims = [],  # noqa: B006
    settings: Set = [],  # noqa: B006
    json_file: Json = None,
) -> None:
    """Actions a second of one policy alone, by batch size: bare, and behind its batch queue; without Ray."""
    from vlagents_ray.bench.figures import measured_on
    from vlagents_ray.bench.policy import PolicyPlan, measure_policy
    from vlagents_ray.serve.launch.deployment_file import server_args

    with errors():
        origin, args, batches = measured_on(), server_args(file, app), parse_counts(batch, "--batch")
        args = args.model_copy(update={"config": args.config | parse_settings(settings, "--set")})
        plan = PolicyPlan(args, batches, seconds, rounds, image, parse_dims(state, "--state"))
        found = measure_policy(plan, progress)
    show_policy(found)
    save({**origin, **found}, json_file)


def show_round_trips(found: Mapping[str, Any], title: str) -> None:
    """Print a row for each client, the fastest first; beside ours, the ratios to other servers."""
    theirs = [peer["way"] for peer in found["peers"]]
    rows = table("way", "median ms", "95 % interval", "p99 ms", *(f"/ {name}" for name in theirs))
    rows.title = f"{title}: two 224x224 RGB cameras, no-op policy"
    for row in sorted([*found["ways"], *found["peers"]], key=lambda one: float(one["median_ms"])):
        low, high = row["ci95_ms"]
        ratios = found["ratios"].get(row["way"], {})
        cells = []
        for name in theirs:
            one = ratios.get(name)
            cells.append(f"{one['ratio']:.2f} ({one['ci95'][0]:.2f}-{one['ci95'][1]:.2f})" if one else "")
        rows.add_row(
            row["way"], f"{row['median_ms']:.3f}", f"{low:.3f} to {high:.3f}", f"{row['p99_ms']:.3f}", *cells,
            style="dim" if row["way"] in theirs else None,
        )  # fmt: skip
    out.print(rows)
    show_skipped(found)


def show_policy(found: Mapping[str, Any]) -> None:
    """Print a row for each batch size."""
    rows = table(
        "batch", "bare actions/s", "ms a batch", "queued actions/s", "of bare", "round trip ms", "p99 ms",
        "mean batch", "peak MiB",
    )  # fmt: skip
    chunk = f", {found['chunk']} rows an action" if (found["chunk"] or 1) > 1 else ""
    rows.title = f"{found['policy']} on {found['device']}{chunk}"
    for row in found["batches"]:
        bare, queued = row["bare"], row["queued"]
        rows.add_row(
            str(row["batch"]), f"{bare['actions_per_s']:.1f}", f"{bare['batch_ms']:.2f}",
            f"{queued['actions_per_s']:.1f}", f"{row['queued_share']:.1%}", f"{queued['round_trip_ms']:.2f}",
            f"{queued['p99_ms']:.2f}", f"{queued['mean_batch']:.2f}", f"{row['peak_mib']:.0f}",
        )  # fmt: skip
    out.print(rows)


def show_throughput(found: Mapping[str, Any]) -> None:
    """Print a row for each number of clients, and a sentence for each transport."""
    rows = table("transport", "clients", "actions/s", "of ideal", "mean batch", "p50 ms", "p99 ms")
    rows.title = f"{found['policy']}, ideal {found['ideal_actions_per_s']:.0f} actions/s ({found['ideal_is']})"
    for name, row in found["transports"].items():
        for point in row["curve"]:
            numbers = [point[key] for key in ("of_ideal", "mean_batch", "p50_ms", "p99_ms")]
            cells = ["" if number is None else f"{number:.3g}" for number in numbers]
            rows.add_row(name, str(point["clients"]), f"{point['actions_per_s']:.1f}", *cells)
        rows.add_section()
    out.print(rows)
    for name, row in found["transports"].items():
        robot = row["robot"]
        waits = (
            f"; a robot among simulations waits {robot['wait_p50_ms']:.1f} ms (p99 {robot['wait_p99_ms']:.1f})"
            if robot
            else ""
        )
        out.print(f"{name}: {row['actions_per_s']:.1f} actions/s, {row['of_ideal']:.3f} of the ideal{waits}")
    show_skipped(found)


def show_skipped(found: Mapping[str, Any]) -> None:
    """Print what could not be measured, and why."""
    for name, reason in found["skipped"].items():
        out.print(Text.assemble((f"skipped {name}", "yellow"), f": {reason}"))
