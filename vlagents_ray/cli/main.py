"""The commands; each is thin around a room of the package."""

from __future__ import annotations

import contextlib
import math
import os
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from vlagents_ray.cli.bench import bench
from vlagents_ray.cli.console import errors as _errors
from vlagents_ray.cli.console import out
from vlagents_ray.cli.environments import env
from vlagents_ray.cli.keys import keys as keys_app
from vlagents_ray.cli.settings import parse_settings
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.serve.checkpoints import resolved
from vlagents_ray.serve.cluster import running_server
from vlagents_ray.serve.files import listens_at, own_settings, read_deployment, with_dialect
from vlagents_ray.serve.tls import Tls

if TYPE_CHECKING:
    from ray.serve.schema import ServeDeploySchema

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Serve Vision-Language-Action models with Ray, and evaluate them in parallel simulation.",
)
Policy = Annotated[str, typer.Option(help="A registered name, a deployment file, or the URL of a running server.")]
Set = Annotated[list[str], typer.Option("--set", metavar="KEY=VALUE", help="A setting of the policy, repeatable.")]
Address = Annotated[
    str | None, typer.Option(help="A running Ray cluster ('auto' finds it); default: one for the run, on this machine.")
]


@app.command()
def serve(
    source: Annotated[str, typer.Argument(help="A registered policy, 'module:Class', or a deployment file (.yaml).")],
    host: Annotated[
        str | None,
        typer.Option(help="0.0.0.0, or one address of this machine, lets others in; default: the file's, 127.0.0.1."),
    ] = None,
    port: Annotated[int | None, typer.Option(min=1, max=65535, help="Default: the file's, or 8000.")] = None,
    settings: Set = [],  # noqa: B006 - typer reads it
    serve_set: Annotated[
        list[str], typer.Option("--serve-set", metavar="KEY=VALUE", help="A setting of the server: batch.max_size=8.")
    ] = [],  # noqa: B006
    vlagents_port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Let clients of the package vlagents in at this port, too.")
    ] = None,
    address: Address = None,
    keys: Annotated[
        Path | None,
        typer.Option(help="File of the API keys (`vlagents-ray keys new`); default: VLAGENTS_RAY_KEYS_FILE or _KEYS."),
    ] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Let in whoever reaches the port, without keys.")
    ] = False,
    tls_cert: Annotated[Path | None, typer.Option(help="Certificate in PEM: serve https:// and wss://.")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="Its key, in PEM.")] = None,
    tls_client_ca: Annotated[
        Path | None, typer.Option(help="Who signs the certificates that clients must show, in PEM.")
    ] = None,
) -> None:
    """Serve a policy until Ctrl-C."""
    with _errors():
        config = read_deployment(source, _server_args(settings, serve_set))
        if vlagents_port is not None:
            config = with_dialect(config, "vlagents", {"port": vlagents_port})
        stated_host, stated_port = listens_at(config)
        host, port = host or stated_host, port or stated_port
        access: dict[str, Any] = {
            "keys_file": keys, "insecure": insecure, "tls": _tls(tls_cert, tls_key, tls_client_ca)
        }  # fmt: skip
        with running_server(config, host=host, port=port, address=address, show_logs=True, **access) as server:
            for name, url in server.apps.items():
                out.print(f"serving [bold]{name}[/] at {url}  (docs: {url}/docs, Ctrl-C stops)", highlight=False)
            with contextlib.suppress(KeyboardInterrupt):
                threading.Event().wait()


@app.command("eval")
def evaluate_command(
    envs: Annotated[list[str], typer.Argument(help="Environments: maniskill/PushCube-v1, tabletop, … (see `envs`).")],
    policy: Policy,
    out_dir: Annotated[Path, typer.Option("--out", help="Folder of the results.")],
    episodes: Annotated[int, typer.Option(min=1, help="Episodes of each environment.")] = 10,
    workers: Annotated[int, typer.Option(min=1, help="Environments rolled out in parallel.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Episode i uses seed + i.")] = 0,
    video: Annotated[str, typer.Option(help="none, failures or all.")] = "failures",
    resume: Annotated[bool, typer.Option(help="Go on with the results in --out.")] = False,
    execute: Annotated[int | None, typer.Option(min=1, help="Rows executed of each chunk; default: all.")] = None,
    retries: Annotated[int, typer.Option(min=0, help="Further attempts after an infrastructure failure.")] = 3,
    settings: Set = [],  # noqa: B006 - typer reads it
    env_set: Annotated[
        list[str], typer.Option("--env-set", metavar="KEY=VALUE", help="An option of the environments: width=256.")
    ] = [],  # noqa: B006
    reset_set: Annotated[
        list[str],
        typer.Option("--reset-set", metavar="KEY=VALUE", help="An option of the policy's reset: checkpoint_step=9."),
    ] = [],  # noqa: B006
    address: Address = None,
) -> None:
    """Evaluate a policy: episodes in parallel, success rates with confidence intervals, videos."""
    with _errors():
        fields: dict[str, Any] = {
            "envs": envs, "episodes": episodes, "workers": workers, "seed": seed, "video": video, "out": out_dir,
            "resume": resume, "execute": execute, "retries": retries,
            "env_options": parse_settings(env_set, "--env-set"),
            "policy_options": parse_settings(reset_set, "--reset-set"),
        }  # fmt: skip
        run_evaluation(policy, parse_settings(settings, "--set"), fields, address)


def run_evaluation(policy: str, settings: dict[str, Any], fields: dict[str, Any], address: str | None = None) -> None:
    """Serve the policy if it is not a URL, evaluate it, print the table."""
    from vlagents_ray.evaluate import EvalConfig, EvaluationInterrupted, check, evaluate, print_summary, progress_for

    with contextlib.ExitStack() as stack:
        if "://" in policy:
            if settings:
                raise ConfigError(f"--set {sorted(settings)}: the server at {policy} has its settings already")
            config = EvalConfig(policy_url=policy, **_served(policy), **fields)
        else:
            deployed = _single_application(policy, settings)
            (app,) = deployed.applications
            own = own_settings(app)
            served = {"policy": app.args["policy"], "policy_config": own, "checkpoint": resolved(own)}
            config = EvalConfig(policy_url=f"serve://{app.name}", **served, **fields)
            check(config)  # what is wrong is said before anything starts
            # Ray's CPUs are bookkeeping here: the number of workers that the user asked for must fit.
            cpus = max(os.cpu_count() or 1, math.ceil(config.workers * config.cpus_per_worker))
            stack.enter_context(running_server(deployed, address=address, num_cpus=cpus))
        try:
            summary = evaluate(config, progress=progress_for(out))
        except EvaluationInterrupted as interrupted:
            print_summary(out, interrupted.summary)
            raise
    print_summary(out, summary)


def _served(url: str) -> dict[str, Any]:
    """What the server at `url` says that it serves: a result belongs to that, not to an address."""
    from vlagents_ray import RemoteAgent

    with RemoteAgent(url) as agent:
        said = agent.metadata
    return {"policy": said["policy"], "policy_config": said.get("config", {}), "checkpoint": said.get("checkpoint")}


def _single_application(policy: str, settings: dict[str, Any]) -> ServeDeploySchema:
    deployed = read_deployment(policy, {"config": settings} if settings else None)
    if len(deployed.applications) != 1:
        names = [one.name for one in deployed.applications]
        raise ConfigError(f"{policy}: holds {names}, want one application; serve it and give the URL of one of them")
    return deployed


@app.command()
def demo(
    out_dir: Annotated[Path, typer.Option("--out", help="Folder of the results.")] = Path("runs/demo"),
) -> None:
    """The main job in a few minutes: serve the scripted policy, evaluate it in two environments, leave videos."""
    from vlagents_ray.envs.maniskill import ManiSkill

    with _errors():
        missing = ManiSkill.missing()
        if missing is None:
            fields: dict[str, Any] = {
                "envs": ["maniskill/PushCube-v1", "maniskill/PickCube-v1"], "episodes": 10, "video": "all"
            }  # fmt: skip
        else:
            out.print(
                f"ManiSkill cannot render here, so the demo uses the built-in tabletop: {missing}", style="yellow"
            )
            fields = {"envs": ["tabletop"], "episodes": 20, "video": "all"}
        run_evaluation("scripted", {}, {**fields, "workers": 2, "out": _fresh(out_dir)})


app.add_typer(bench, name="bench")
app.add_typer(env, name="env")
app.add_typer(keys_app, name="keys")


@app.command()
def policies() -> None:
    """List the policies that can be served by name."""
    from vlagents_ray.registry import names

    table = Table("policy", "class")
    for name, target in sorted(names("policies").items()):
        table.add_row(name, target)
    out.print(table)


@app.command()
def envs() -> None:
    """List the environments, their tasks, and what keeps one from running here."""
    from vlagents_ray.registry import env_class, names

    table = Table("environment", "tasks", "here")
    for name in sorted(names("envs")):
        try:
            cls = env_class(name)
            missing = cls.missing()
            tasks = cls.tasks()
        except VLAgentsError as error:
            missing, tasks = str(error), []
        table.add_row(
            name, ", ".join(tasks) or "any", "[green]ready[/]" if missing is None else f"[yellow]{missing}[/]"
        )
    out.print(table)


@app.command()
def doctor(port: Annotated[int, typer.Option(help="The port that a server would take.")] = 8000) -> None:
    """Check this machine: Python, Ray, GPU, rendering, shared memory, ports, video; each with the cure."""
    from vlagents_ray.cli.doctor import run

    raise typer.Exit(run(out, port))


def _tls(certificate: Path | None, key: Path | None, client_ca: Path | None) -> Tls | None:
    if certificate is None and key is None and client_ca is None:
        return None
    if certificate is None or key is None:
        raise ConfigError("TLS: give both --tls-cert and --tls-key")
    return Tls(certificate, key, client_ca)


def _server_args(settings: list[str], serve_set: list[str]) -> dict[str, Any]:
    args = parse_settings(serve_set, "--serve-set")
    if "config" in args:
        raise ConfigError("--serve-set config: the policy's own settings go into --set")
    config = parse_settings(settings, "--set")
    return {**args, **({"config": config} if config else {})}


def _fresh(folder: Path) -> Path:
    """`folder`, or the first of folder-2, folder-3, … that does not exist: a demo never mixes with an older one."""
    candidate, number = folder, 1
    while candidate.exists():
        number += 1
        candidate = folder.with_name(f"{folder.name}-{number}")
    return candidate
