"""`vlagents-ray bench`: measurements that users can repeat on their own machines."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vlagents_ray.cli.bench_evaluations import bench_eval, bench_evaluation, bench_soak
from vlagents_ray.cli.bench_scaling import bench_autoscaling, bench_scaling
from vlagents_ray.cli.console import errors, out, save, tell
from vlagents_ray.cli.options import DEFAULT_PEERS_PYTHON, PEERS_DIR, Json, PeersPython, Plot
from vlagents_ray.cli.settings import parse_counts, parse_list, parse_settings
from vlagents_ray.cli.tables import show_policy, show_round_trips, show_throughput
from vlagents_ray.errors import ConfigError

if TYPE_CHECKING:
    from vlagents_ray.bench.throughput import Plan

bench = typer.Typer(no_args_is_help=True, help="Measure on this machine what the README claims.")

Peers = Annotated[str, typer.Option(help="vlagents, openpi, openvla, vla-eval, with commas between them, or 'all'.")]


@bench.command("rtt")
def bench_rtt(
    calls: Annotated[int, typer.Option(min=1, help="Round trips by each way.")] = 1000,
    transports: Annotated[str, typer.Option(help="Of ours: shm,websocket,http,handle,plasma; default: all.")] = "",
    peers: Peers = "",
    peers_python: PeersPython = DEFAULT_PEERS_PYTHON,
    json_file: Json = None,
    plot: Plot = None,
) -> None:
    """Round trips to a `noop` policy on this machine: every transport, and other policy servers, interleaved."""
    from vlagents_ray.bench.plot import check, plot_round_trips
    from vlagents_ray.bench.rtt import measure_rtt

    with errors():
        check(plot)
        found = measure_rtt(
            calls, transports=parse_list(transports), peers=parse_list(peers), peers_python=peers_python, tell=tell
        ).to_json()
        show_round_trips(found, "round trip of one act on this machine")
        save(found, json_file)
        if plot is not None:
            plot_round_trips(found, plot)


@bench.command("link")
def bench_link(
    calls: Annotated[int, typer.Option(min=1, help="Round trips by each way.")] = 600,
    rate: Annotated[str, typer.Option(help="Of the link, as tc writes it.")] = "1gbit",
    delay: Annotated[str | None, typer.Option(help="Each way, as tc writes it: 2ms. Needs the kernel's netem.")] = None,
    peers: Peers = "vlagents,openpi",
    peers_python: PeersPython = DEFAULT_PEERS_PYTHON,
    json_file: Json = None,
    plot: Plot = None,
) -> None:
    """Round trips over a link of 1 Gbit/s between two network namespaces on this machine."""
    from vlagents_ray.bench.link import measure_link
    from vlagents_ray.bench.plot import check, plot_round_trips

    with errors():
        check(plot)
        found = measure_link(
            calls, rate=rate, delay=delay, peers=parse_list(peers), peers_python=peers_python, tell=tell
        )  # fmt: skip
        title = f"round trip of one act over {found['link']['measured_mbit_per_s']:.0f} Mbit/s"
        show_round_trips(found, title)
        save(found, json_file)
        if plot is not None:
            plot_round_trips(found, plot, title)


@bench.command("hop")
def bench_hop(
    calls: Annotated[int, typer.Option(min=1, help="Acts by each way.")] = 2000,
    python: Annotated[str, typer.Option(help="The child's interpreter; default: this one.")] = sys.executable,
    json_file: Json = None,
) -> None:
    """What a policy in a child process behind the replica costs, against one in the replica."""
    from vlagents_ray.bench.hop import measure_hop

    with errors():
        found = measure_hop(calls, python, tell).to_json()
    show_round_trips(found, "one act, as the batch queue sees it")
    save(found, json_file)


@bench.command("throughput")
def bench_throughput(
    transports: Annotated[str, typer.Option(help="With commas between them.")] = "plasma,handle,shm,websocket",
    clients: Annotated[str, typer.Option(help="Numbers of clients; the greatest is compared with the ideal.")] = (
        "1,2,4,8,16,32"
    ),
    batch: Annotated[int, typer.Option(min=1, help="Observations in one forward pass, at most.")] = 16,
    seconds: Annotated[float, typer.Option(min=0.1, help="Of each measurement.")] = 2.0,
    rounds: Annotated[int, typer.Option(min=1)] = 3,
    robot_seconds: Annotated[float, typer.Option(min=0, help="How long a robot is watched; 0: not at all.")] = 10.0,
    policy: Annotated[
        str | None, typer.Option(help="A registered name or module:Class; default: noop, 20 ms + 1 ms an observation.")
    ] = None,
    config: Annotated[str, typer.Option(help="The policy's settings, as JSON.")] = "{}",
    model: Annotated[
        str | None, typer.Option(help="A transformer with random weights, in the policy's place: tiny, pi0, openvla.")
    ] = None,
    device: Annotated[str, typer.Option(help="Where the transformer runs: cpu, cuda.")] = "cpu",
    num_gpus: Annotated[
        float | None, typer.Option(min=0, help="That Ray gives to the replica; default: 1 for --device cuda, else 0.")
    ] = None,
    json_file: Json = None,
) -> None:
    """Actions a second of many clients on one replica, against the ideal, or the bare policy in the same run."""
    from vlagents_ray.bench.throughput import Plan, measure_throughput

    with errors():
        chosen = _policy(policy, config, model, device)
        counts = parse_counts(clients, "--clients")
        gpus = float(device.startswith("cuda")) if num_gpus is None else num_gpus
        plan: Plan = Plan(
            **chosen, num_gpus=gpus, batch=batch, clients=counts, seconds=seconds, rounds=rounds,
            robot_seconds=robot_seconds, transports=parse_list(transports),
        )  # fmt: skip
        found = measure_throughput(plan, tell)
    show_throughput(found)
    save(found, json_file)


@bench.command("policy")
def bench_policy(
    file: Annotated[str, typer.Argument(help="A deployment file, or a registered policy.")],
    batch: Annotated[str, typer.Option(help="Batch sizes, with commas between them.")] = "1,8",
    seconds: Annotated[float, typer.Option(min=0.1, help="Of each measurement.")] = 2.0,
    rounds: Annotated[int, typer.Option(min=1)] = 3,
    app: Annotated[str | None, typer.Option(help="Of the file, if it holds several.")] = None,
    image: Annotated[int, typer.Option(min=1, help="Pixels a side, where the policy takes any image.")] = 224,
    state: Annotated[
        list[str], typer.Option(metavar="PART=N", help="Numbers in a part for which the policy does not say.")
    ] = [],  # noqa: B006
    json_file: Json = None,
) -> None:
    """Actions a second of one policy alone, by batch size: bare, and behind its batch queue; without Ray."""
    from vlagents_ray.bench.policies import PolicyPlan, measure_policy
    from vlagents_ray.serve.files import server_args

    with errors():
        dims = parse_settings(state, "--state")
        if not all(isinstance(number, int) and number > 0 for number in dims.values()):
            raise ConfigError(f"--state: got {dims}, want a number from 1 on for each part")
        args, batches = server_args(file, app), parse_counts(batch, "--batch")
        found = measure_policy(PolicyPlan(args, batches, seconds, rounds, image, dims), tell)
    show_policy(found)
    save(found, json_file)


bench.command("eval")(bench_eval)
bench.command("evaluation")(bench_evaluation)
bench.command("soak")(bench_soak)
bench.command("scaling")(bench_scaling)
bench.command("autoscaling")(bench_autoscaling)


@bench.command("peers-setup")
def bench_peers_setup(
    folder: Annotated[Path, typer.Option("--dir", help="Folder of the environment.")] = PEERS_DIR,
) -> None:
    """Install other policy servers, at pinned versions, in a Python environment of their own."""
    from vlagents_ray.bench.environment import set_up

    with errors():
        python = set_up(folder, tell)
    used = "" if folder == PEERS_DIR else f" --peers-python {python}"
    out.print(f"ready: vlagents-ray bench rtt --peers all{used}", highlight=False, soft_wrap=True)


@bench.command("report")
def bench_report(
    readme: Annotated[Path, typer.Option(help="Its text between the bench markers is replaced.")] = Path("README.md"),
    json_file: Annotated[Path, typer.Option("--json", help="Keep the figures here.")] = Path("benchmarks/latest.json"),
    calls: Annotated[int, typer.Option(min=1, help="Round trips by each way.")] = 1000,
    seconds: Annotated[float, typer.Option(min=0.1, help="Of each measurement of the throughput.")] = 2.0,
    peers_python: PeersPython = DEFAULT_PEERS_PYTHON,
    from_json: Annotated[bool, typer.Option("--from-json", help="Measure nothing: use the figures in --json.")] = False,
) -> None:
    """Measure everything, and write the README's benchmark section anew."""
    from vlagents_ray.bench.markdown import replaced
    from vlagents_ray.bench.report import collect, write
    from vlagents_ray.bench.throughput import Plan

    with errors():
        if not readme.is_file():
            raise ConfigError(f"--readme {readme}: does not exist")
        replaced(readme.read_text(), "")  # raises without markers, before anything is measured
        if from_json:
            try:
                results = json.loads(json_file.read_text())
            except (OSError, ValueError) as error:
                raise ConfigError(f"--json {json_file}: cannot be read ({error})") from error
        else:
            results = collect(
                peers_python, calls=calls, link_calls=calls, plan=Plan(seconds=seconds), tell=tell
            )  # fmt: skip
        write(results, readme, None if from_json else json_file)
    out.print(f"wrote {readme}", highlight=False)


def _policy(policy: str | None, config: str, model: str | None, device: str) -> dict[str, Any]:
    try:
        settings = json.loads(config)
    except ValueError as error:
        raise ConfigError(f"--config: got {config!r}, want JSON ({error})") from error
    if not isinstance(settings, dict):
        raise ConfigError(f"--config: got {config!r}, want a JSON object")
    if model is not None:
        if policy is not None:
            raise ConfigError("--policy and --model exclude each other; keep one")
        return {
            "policy": "vlagents_ray.bench.model:SizedPolicy",
            "config": {"size": model, "device": device, **settings},
        }
    if policy is not None:
        return {"policy": policy, "config": settings}
    if settings:
        raise ConfigError("--config: is for --policy or --model; name one")
    return {}
