"""The commands of `vlagents-ray`, which call other subpackages. This module does not import Ray."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlagents_ray.cli import results
from vlagents_ray.cli.console import errors, fail, fresh, out, print_json, progress, table
from vlagents_ray.cli.evaluate import evaluate_command
from vlagents_ray.cli.examples import EXAMPLES, epilog
from vlagents_ray.cli.help_page import VERSION, version_line
from vlagents_ray.cli.init import init
from vlagents_ray.cli.keys import keys
from vlagents_ray.cli.options import AsJson, Commands
from vlagents_ray.cli.serve import serve_command
from vlagents_ray.cli.typer_help import use_help_pages
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.naming import did_you_mean
from vlagents_ray.registry import (
    find_entry,
    name_is_taken,
    names,
    not_installed,
    pip_install,
    registered_function,
)

if TYPE_CHECKING:
    from vlagents_ray.cli.listing import Listed

logger = logging.getLogger(__name__)

OneName = Annotated[
    str | None, typer.Argument(metavar="[NAME]", help="Show the details of this name alone.")
]

app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    # Errors are plain text, like the errors of `vlagents-ray robot`.
    rich_markup_mode=None,
    context_settings={"help_option_names": ["--help", "-h"]},
)


def _print_version(requested: bool) -> None:
    """Print the version, and end the command."""
    if requested:
        out.print(version_line())
        raise typer.Exit


@app.callback(
    epilog=epilog(
        (
            "demo",
            "serve deployments/pi0.yaml",
            "eval tabletop --policy scripted",
            "robot http://gpu-box:8000 --robot my_arm:MyArm",
        )
    )
)
def commands(
    version: Annotated[
        bool,
        typer.Option("--version", is_eager=True, callback=_print_version, help=VERSION),
    ] = False,
) -> None:
    """Serve Vision-Language-Action models with Ray, and evaluate them in parallel simulation."""


venv = typer.Typer(
    no_args_is_help=True,
    help="Create Python environments for policies that cannot run in the server's environment.",
)
_MORE = "More commands"
app.command("serve")(serve_command)
app.command("eval", short_help="Evaluate policies in parallel: success with intervals, videos.")(
    evaluate_command
)


@app.command(
    "robot",
    add_help_option=False,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
)
def robot_command(context: typer.Context) -> None:
    """Drive a robot or simulation with a policy, an operator, or both."""
    from vlagents_ray.cli.robot import main

    raise typer.Exit(main(context.args))


@app.command(short_help="Serve and evaluate a policy in a minute, with videos.")
def demo(
    out_dir: Annotated[
        Path, typer.Option("--out", metavar="FOLDER", help="Folder of the results.")
    ] = Path("runs/demo"),
) -> None:
    """Serve a policy, evaluate it on four tasks of the tabletop, and record videos, in a minute.

    In a checkout this is the reference policy, which was trained. Elsewhere it is the scripted
    policy, which needs no weights.
    """
    from vlagents_ray.cli.evaluation import run_evaluation
    from vlagents_ray.evaluate import EvalConfig, PolicyConfig, SuiteConfig

    rates = Path("examples/reference/checkpoint/rates.json")
    if rates.is_file():
        counts = json.loads(rates.read_text())["tabletop"].values()
        successes = sum(count[0] for count in counts)
        episodes = sum(count[1] for count in counts)
        out.print(
            "The policy was trained on demonstrations, and solves "
            f"{100 * successes / episodes:.0f} % of {episodes} such episodes; its card is "
            f"{rates.parent}/README.md."
        )
        policy = PolicyConfig(name="reference", source="deployments/reference.yaml")
    else:
        policy = PolicyConfig(name="scripted", source="scripted")

    tasks = ["tabletop/pick_place", "tabletop/slide", "tabletop/stack", "tabletop/lift"]
    suite = SuiteConfig(
        envs=tasks,
        env_options={"cameras": ["front", "wrist"], "width": 64, "height": 64},
        episodes=5,
    )
    with errors():
        config = EvalConfig(
            policies=[policy], suites=[suite], workers=2, video="all", out=fresh(out_dir)
        )
        run_evaluation(config)


@app.command(short_help="Check this machine, and print the cure of each problem.")
def doctor(
    port: Annotated[
        int,
        typer.Option(
            min=1, max=65535, metavar="PORT", help="The port on which a server would listen."
        ),
    ] = 8000,
    python: Annotated[
        list[Path],
        typer.Option(
            metavar="FILE",
            help="The Python of a policy's environment. May be repeated; default: those in "
            ".venv-*.",
        ),
    ] = [],  # noqa: B006
    as_json: AsJson = False,
) -> None:
    """Check Python, Ray, the GPU, torch, JAX, rendering, shared memory and ports of this machine,
    and print the cure of each problem.

    Exit status: 0 if no check failed, 1 if one did.
    """
    from vlagents_ray.cli.doctor import run

    with errors():
        status = run(out, port, python, as_json=as_json)
    raise typer.Exit(status)


# The short descriptions fit into 80 columns, so that the list of all commands fits on one screen.
for _command, _name, _short_help in (
    (results.report_command, "report", "Write the report of an evaluation again."),
    (results.export_command, "export", "Write episodes as JSON, CSV, Parquet or a LeRobotDataset."),
    (results.replay_command, "replay", "Run an episode again, and compare the actions."),
):
    app.command(_name, short_help=_short_help, rich_help_panel=_MORE)(_command)
for _commands, _name, _short_help in (
    (venv, "venv", "Create Python environments for policies."),
    (keys, "keys", "Create, list and revoke the API keys of a server."),
    (init, "init", "Write a working skeleton, with its test."),
):
    app.add_typer(_commands, name=_name, short_help=_short_help, rich_help_panel=_MORE)


def _add_commands_of_plugins() -> None:
    """Add the commands of installed plug-ins; a command that cannot be imported fails when it is
    called. A command of this package is not replaced.
    """
    own = set(typer.main.get_group(app).commands)
    for name in names("commands"):
        if "." in name:  # a subcommand, which `cli.robot` runs
            continue
        if name in own:
            logger.warning("%s", name_is_taken("commands", name))
            continue
        try:
            command = registered_function("commands", name)
            entry = find_entry("commands", name)
        except VLAgentsError as error:
            _add_failing(name, "It cannot be loaded.", str(error))
            continue
        about = "" if entry is None else entry.about
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, short_help=about, rich_help_panel=_MORE)
        else:
            examples = () if entry is None else entry.examples
            app.command(
                name,
                short_help=about,
                rich_help_panel=_MORE,
                epilog=epilog(examples) if examples else None,
            )(command)

    for name, distribution in not_installed("commands").items():
        if "." in name:
            continue
        cure = pip_install(distribution=distribution)
        message = f"command {name!r} is in {distribution}, which is not installed: {cure}"
        _add_failing(name, f"Not installed: {cure}.", message)


def _add_failing(name: str, short_help: str, message: str) -> None:
    """Add a command that accepts any arguments and fails with a message."""

    def failing() -> None:
        fail(message, 2)

    context = {"allow_extra_args": True, "ignore_unknown_options": True}
    app.command(
        name, short_help=short_help, help=message, rich_help_panel=_MORE, context_settings=context
    )(failing)


_add_commands_of_plugins()


@app.command(
    short_help="List policies and wrappers, and how to install them.", rich_help_panel=_MORE
)
def policies(name: OneName = None, as_json: AsJson = False) -> None:
    """List policies and wrappers: their models, whether their packages are installed, and how to
    install them.
    """
    from vlagents_ray.cli.listing import policies_and_wrappers

    _list(list(policies_and_wrappers()), name, as_json=as_json)


@app.command(short_help="List environments, and how to install them.", rich_help_panel=_MORE)
def envs(name: OneName = None, as_json: AsJson = False) -> None:
    """List environments: their tasks, whether they run here, and how to install them."""
    from vlagents_ray.cli.listing import environments

    _list(list(environments()), name, as_json=as_json)


def _list(listed: Sequence[Listed], name: str | None, *, as_json: bool) -> None:
    """Print a listing.

    Args:
        listed: The entries.
        name: The name whose details are printed; None prints a line for each entry, and the
            commands that install missing packages.
        as_json: Whether to print a JSON document.
    """
    from vlagents_ray.cli.listing import installing

    chosen = [entry for entry in listed if name in (None, entry.name)]
    if not chosen:
        registered = [entry.name for entry in listed]
        cure = did_you_mean(str(name), registered) or f"; there are {', '.join(registered)}"
        fail(f"{name!r} is not registered{cure}", 2)

    if as_json:
        print_json([asdict(entry) for entry in chosen])
        return
    if name is not None:
        for line in chosen[0].lines():
            out.print(line)
        return

    has_kinds = len({entry.kind for entry in chosen}) > 1
    columns = ["name", "kind", "here", "what"] if has_kinds else ["name", "here", "what"]
    rows = table(*columns, box=None)
    for entry in chosen:
        cells = [entry.name, "no" if entry.missing else "yes", entry.what]
        if has_kinds:
            cells.insert(1, entry.kind)
        rows.add_row(*cells)
    out.print(rows)

    cures = list(installing(chosen))
    if cures:
        makes_env = any("venv create" in line and line.startswith("vlagents-ray") for line in cures)
        hint = ", whose Python a deployment names as `environment`" if makes_env else ""
        out.print(f"\nfor the rest{hint}:")
    for line in cures:
        out.print(f"  {line}")


@venv.command("create")
def create(
    requirements: Annotated[
        Path,
        typer.Argument(
            metavar="REQUIREMENTS",
            help="The name of a model family, such as lerobot, or a requirements file.",
        ),
    ],
    out_dir: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FOLDER", help="Folder of the environment; default: .venv-NAME."
        ),
    ] = None,
    more: Annotated[
        list[Path],
        typer.Option(
            "--with", metavar="FILE", help="A further requirements file. May be repeated."
        ),
    ] = [],  # noqa: B006
    python: Annotated[
        str | None,
        typer.Option(
            metavar="PYTHON",
            help="Version or interpreter of Python; default: the version in the file, or the "
            "version that runs this command.",
        ),
    ] = None,
    light: Annotated[
        bool, typer.Option("--light", help="Install no Ray, for a policy in a child process.")
    ] = False,
    cuda: Annotated[
        bool,
        typer.Option(
            "--cuda", help="Install CUDA packages (several GB) even on a machine without a GPU."
        ),
    ] = False,
) -> None:
    """Create a virtual environment with this vlagents-ray and a policy's requirements, and print
    how to use it.
    """
    from vlagents_ray.registry import requirements_file
    from vlagents_ray.serve.python_env.create import make_environment

    is_name = str(requirements) == requirements.stem and not requirements.is_file()
    with errors():
        file = requirements_file(requirements.name) if is_name else requirements
        folder = out_dir or Path(f".venv-{file.stem}")
        interpreter = make_environment(
            file, folder, more=more, python=python, light=light, cuda=cuda, progress=progress
        )
    out.print(f"ready; in a deployment file, under args:\n\nenvironment:\n  python: {interpreter}")


def _add_examples(group: typer.Typer, prefix: str = "") -> None:
    """Add the examples of this package's commands to their help."""
    for command in group.registered_commands:
        callback_name = getattr(command.callback, "__name__", "")
        name = f"{prefix}{command.name or callback_name}"
        if name in EXAMPLES:
            command.epilog = epilog(EXAMPLES[name])
    for subgroup in group.registered_groups:
        if subgroup.typer_instance is not None:
            _add_examples(subgroup.typer_instance, f"{prefix}{subgroup.name} ")


_add_examples(app)
use_help_pages(app)
