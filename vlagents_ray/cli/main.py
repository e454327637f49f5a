"""The commands; each is thin around a room of the package."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from vlagents_ray.cli.bench import bench
from vlagents_ray.cli.console import errors as _errors
from vlagents_ray.cli.console import fresh, out
from vlagents_ray.cli.environments import env
from vlagents_ray.cli.evaluation import Address, Set, evaluate_command, run_evaluation
from vlagents_ray.cli.export import export_command
from vlagents_ray.cli.keys import keys as keys_app
from vlagents_ray.cli.merge import merge_command
from vlagents_ray.cli.replay import replay_command
from vlagents_ray.cli.report import report_command
from vlagents_ray.cli.settings import parse_settings
from vlagents_ray.cli.slurm import slurm
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.serve.cluster import running_server
from vlagents_ray.serve.files import listens_at, read_deployment, with_dialect
from vlagents_ray.serve.tls import Tls

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Serve Vision-Language-Action models with Ray, and evaluate them in parallel simulation.",
)


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


@app.command()
def demo(
    out_dir: Annotated[Path, typer.Option("--out", help="Folder of the results.")] = Path("runs/demo"),
) -> None:
    """The main job in a few minutes: serve the scripted policy, evaluate it in two environments, leave videos."""
    from vlagents_ray.envs.maniskill import ManiSkill
    from vlagents_ray.evaluate import EvalConfig, PolicyConfig, SuiteConfig

    with _errors():
        missing = ManiSkill.missing()
        suite = SuiteConfig(envs=["maniskill/PushCube-v1", "maniskill/PickCube-v1"], episodes=10)
        if missing is not None:
            out.print(
                f"ManiSkill cannot render here, so the demo uses the built-in tabletop: {missing}", style="yellow"
            )
            suite = SuiteConfig(envs=["tabletop"], episodes=20)
        policy = PolicyConfig(name="scripted", source="scripted")
        run_evaluation(EvalConfig(policies=[policy], suites=[suite], workers=2, video="all", out=fresh(out_dir)))


app.command("eval")(evaluate_command)
app.command("export")(export_command)
app.command("merge")(merge_command)
app.command("replay")(replay_command)
app.command("report")(report_command)
app.add_typer(bench, name="bench")
app.add_typer(env, name="env")
app.add_typer(keys_app, name="keys")
app.add_typer(slurm, name="slurm")


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
