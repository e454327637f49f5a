"""The commands of `vlagents-ray bench` that run whole evaluations."""

from __future__ import annotations

from typing import Annotated

import typer

from vlagents_ray.cli.console import errors, out, save, tell
from vlagents_ray.cli.options import DEFAULT_PEERS_PYTHON, Json, PeersPython
from vlagents_ray.cli.settings import parse_list, parse_settings
from vlagents_ray.cli.tables import show_evaluation, show_overhead, show_soak

Workers = Annotated[int, typer.Option(min=1)]


def bench_eval(
    env: Annotated[str, typer.Argument(help="The environment to step.")] = "tabletop",
    workers: Workers = 2,
    episodes: Annotated[int, typer.Option(min=1, help="For each worker and round.")] = 8,
    rounds: Annotated[int, typer.Option(min=1)] = 3,
    json_file: Json = None,
    env_set: Annotated[list[str], typer.Option("--env-set", metavar="KEY=VALUE")] = [],  # noqa: B006
) -> None:
    """Steps a second, and CPU time a step, of an evaluation against those of the bare environments."""
    from vlagents_ray.bench.overhead import measure_overhead

    with errors():
        options = parse_settings(env_set, "--env-set")
        found = measure_overhead(env, workers=workers, episodes=episodes, rounds=rounds, env_options=options, tell=tell)
    show_overhead(found)
    data = found.to_json()
    out.print(f"median ratio {found.ratio:.3f}, CPU time added to a step {data['median_added_cpu_ms_per_step']:.3f} ms")
    save(data, json_file)


def bench_evaluation(
    episodes: Annotated[int, typer.Option(min=1, help="Of each system and round.")] = 200,
    workers: Workers = 2,
    peers: Annotated[str, typer.Option(help="vlagents, vla-eval, with a comma between them, or 'all'.")] = "",
    rounds: Annotated[int, typer.Option(min=1)] = 3,
    size: Annotated[int, typer.Option(min=32, help="Pixels a side of the image.")] = 224,
    max_steps: Annotated[int, typer.Option(min=1, help="Steps of an episode.")] = 80,
    env_ms: Annotated[float, typer.Option(min=0, help="CPU time that each env step takes more.")] = 0.0,
    peers_python: PeersPython = DEFAULT_PEERS_PYTHON,
    json_file: Json = None,
) -> None:
    """Episodes a minute of whole evaluations: `vlagents-ray eval`, and the peers' own commands, in turns."""
    from vlagents_ray.bench.evaluation import EvaluationPlan, measure_evaluation

    with errors():
        plan = EvaluationPlan(episodes, workers, rounds, size, max_steps, env_ms)
        found = measure_evaluation(plan, peers=parse_list(peers), peers_python=peers_python, tell=tell)
    show_evaluation(found)
    save(found, json_file)


def bench_soak(
    episodes: Annotated[int, typer.Option(min=100)] = 10_000,
    workers: Workers = 2,
    kill_every: Annotated[float, typer.Option(min=0, help="Seconds between two kills of a worker; 0: none.")] = 30.0,
    json_file: Json = None,
) -> None:
    """Many short episodes, with workers killed meanwhile: memory, what an episode costs around it, each once."""
    from vlagents_ray.bench.soak import SoakPlan, measure_soak

    with errors():
        found = measure_soak(SoakPlan(episodes, workers, kill_every), tell)
    show_soak(found)
    save(found, json_file)
