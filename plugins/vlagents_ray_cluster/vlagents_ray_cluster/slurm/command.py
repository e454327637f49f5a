"""`vlagents-ray slurm`: evaluations and policy servers as Slurm jobs."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vlagents_ray.bounds import MOST_RETRIES, MOST_S
from vlagents_ray.cli.console import errors, out
from vlagents_ray.cli.evaluate import EvalOptions, config_from_options, evaluate_command
from vlagents_ray.cli.examples import epilog
from vlagents_ray.cli.options import finite
from vlagents_ray.cli.serve import ServeOptions, serve_command
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import registered_class
from vlagents_ray_cluster.slurm.submission import Script, first_index, split, submit

if TYPE_CHECKING:
    from vlagents_ray.evaluate import EvalConfig
    from vlagents_ray.evaluate.plan.cases import EvalCase

slurm = typer.Typer(
    no_args_is_help=True,
    help="Submit evaluations and servers as Slurm jobs. Options that are not listed here, such as "
    "--nodes and --time, are passed to sbatch.",
)
_BOTH = {"allow_extra_args": True, "ignore_unknown_options": True}
_FOUND_OUT = "the job determines it itself"  # the reason why an option does not fit a job
_TASK = "%a"  # replaced by the number of a task of --array, as in sbatch's file names
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Print the script, without writing or submitting it.")
]
Parsable = Annotated[bool, typer.Option("--parsable", help="Print only the number of the job.")]
Setup = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="File of shell commands that the job runs first, such as module load and export.",
    ),
]


@slurm.command(
    "eval",
    context_settings=_BOTH,
    options_metavar="[OPTIONS] FILE | ENV...",
    epilog=epilog(
        (
            "slurm eval runs.yaml --nodes 2 --gpus-per-node 4 --time 4:00:00 --resubmit 5",
            "slurm eval tabletop --policy scripted --out runs/a/%a --array 0-3 --seed %a00",
        )
    ),
)
def eval_(
    context: typer.Context,
    resubmit: Annotated[
        int,
        typer.Option(
            min=0,
            max=MOST_RETRIES,
            metavar="N",
            help="How often the job submits itself again when its time is over.",
        ),
    ] = 0,
    closing_s: Annotated[
        float,
        typer.Option(
            min=0,
            max=MOST_S,
            callback=finite,
            metavar="S",
            help="Stop this many seconds before the job's time limit.",
        ),
    ] = 60.0,
    setup: Setup = None,
    dry_run: DryRun = False,
    parsable: Parsable = False,
) -> None:
    """Evaluate in a job, with the options of `vlagents-ray eval` and of sbatch.

    The job continues existing results, so the same command after `scancel` or a failure runs the
    remaining episodes. Without --workers, the job has a worker for each CPU except one, and a
    replica of the policy on each GPU.
    """
    from vlagents_ray.evaluate import most_cpus, most_gpus

    with errors():
        words, options = split(context.args, _options(evaluate_command))
        index = first_index(options.get("array") or "0")
        config, cases = _evaluation([word.replace(_TASK, index) for word in words])
        # Another number in the place of the task's, which need not be a task of the array.
        other_config, _ = _evaluation([word.replace(_TASK, f"{index}0") for word in words])
        for tracker in config.track:
            registered_class("trackers", tracker)  # raises an error for an unknown name
        if "array" in options and config.out == other_config.out:
            raise ConfigError(
                f"--array: expected a folder for each task, got the same folder for all; put "
                f"{_TASK} in it, "
                f"as in --out runs/x/{_TASK}"
            )

        # Without --workers, the workers fill the job. In that case they must not have GPUs, since
        # the number of GPUs that policies need is not known.
        fill = []
        if "workers" not in config.model_fields_set:
            if most_gpus(cases):
                raise ConfigError(
                    "workers: expected the number of workers, as they have GPUs, got none; set "
                    "--workers, "
                    "as policies get the GPUs left over"
                )
            fill = [f"--fill={max(1.0, most_cpus(cases)):g}"]

        # The common parent of the tasks' folders, if there is an array.
        folder = Path(os.path.commonpath([config.out, other_config.out])) / "slurm"
        arguments = ["eval", *fill, f"--closing-s={closing_s:g}", "--", *words]
        _submit(Script("eval", folder, arguments, options, resubmit, setup), dry_run, parsable)


@slurm.command(
    "serve",
    context_settings=_BOTH,
    options_metavar="[OPTIONS] POLICY",
    epilog=epilog(
        (
            "slurm serve deployments/pi0.yaml --gpus-per-node 1 --time 8:00:00",
            "slurm serve scripted --time 1:00:00 --dry-run",
        )
    ),
)
def serve(
    context: typer.Context,
    out_dir: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FOLDER",
            help="Folder of the script, the logs and server.json; default: runs/serve/POLICY.",
        ),
    ] = None,
    setup: Setup = None,
    dry_run: DryRun = False,
    parsable: Parsable = False,
) -> None:
    """Serve a policy in a job, with the options of `vlagents-ray serve` and of sbatch.

    When the server is ready, OUT/JOB/server.json and the job's log contain the URL, the key and
    the ssh command.
    """
    with errors():
        words, options = split(context.args, _options(serve_command))
        serve_options = _parse("serve", serve_command, words)
        _reject(serve_options, _FOUND_OUT, "address", "host")
        _reject(
            serve_options,
            "its server speaks no TLS, the ssh line encrypts",
            "tls_cert",
            "tls_key",
            "tls_client_ca",
        )
        if "array" in options:
            raise ConfigError("--array: a server is one job; submit several")

        source = serve_options["source"]
        arguments = ["serve"]
        for app in ServeOptions(**serve_options).deployment().applications:
            arguments.append(f"--app={app.name}={app.route_prefix or '/'}")
        if serve_options["port"] is not None:
            arguments.append(f"--port={serve_options['port']}")
        if serve_options["keys"] is None and not serve_options["insecure"]:
            arguments.append("--key")

        folder = out_dir or Path("runs") / "serve" / Path(source).stem
        script = Script("serve", folder, [*arguments, "--", *words], options, setup=setup)
        _submit(script, dry_run, parsable)


def _submit(script: Script, dry_run: bool, parsable: bool) -> None:
    """Submit a script, and print how to follow the job."""
    if script.setup is not None and not script.setup.is_file():
        raise ConfigError(
            f"--setup: expected a file of shell lines, got {str(script.setup)!r}, which is none"
        )
    if dry_run:
        typer.echo(script.text(), nl=False)
        return
    job = submit(script)
    if parsable:
        typer.echo(job)
        return
    number = "*" if "array" in script.options else job  # each task of an array has its own number
    log = script.options.get("output") or f"{script.folder}/{number}.log"
    lines = [
        f"job {job} is queued; its script: {script.file}",
        f"  state   squeue --jobs={job}",
        f"  log     {log}, and Ray's of each node in {script.folder}/{number}/",
    ]
    if script.name == "serve":
        lines.append(f"  way in  {script.folder}/{number}/server.json, once it answers")
    lines.append(f"  end it  scancel {job}")
    out.print("\n".join(lines))


def _options(command: Callable[..., None]) -> dict[str, bool]:
    """Return the options of a command, and whether each takes a value."""
    takes_value = {}
    for param in _click(command).params:
        if not hasattr(param, "is_flag"):  # a positional argument
            continue
        for name in param.opts:
            takes_value[name] = not param.is_flag
    return takes_value


def _parse(name: str, command: Callable[..., None], words: list[str]) -> dict[str, Any]:
    """Parse the arguments of a command; raises the command's errors."""
    context = _click(command).make_context(f"vlagents-ray slurm {name}", list(words))
    params: dict[str, Any] = context.params
    return params


def _click(command: Callable[..., None]) -> Any:
    """Return the Click command that Typer creates from a function."""
    app = typer.Typer(add_completion=False)
    app.command()(command)
    return typer.main.get_command(app)


def _reject(params: dict[str, Any], why: str, *names: str) -> None:
    """Raise `ConfigError` if one of these options is set; `why` is the reason."""
    options = [f"--{name.replace('_', '-')}" for name in names if params[name]]
    if options:
        raise ConfigError(f"{', '.join(options)}: not for a job: {why}; leave it out")


def _evaluation(words: list[str]) -> tuple[EvalConfig, list[EvalCase]]:
    """Build the configuration and the cases as `eval` does.

    This raises the errors with which the job would end at its start.
    """
    from vlagents_ray.cli.policies import resolve_policies
    from vlagents_ray.evaluate.plan.cases import plan_cases

    options = _parse("eval", evaluate_command, words)
    _reject(options, _FOUND_OUT, "address", "end_at")
    _reject(
        options,
        "it would wait for a training; let the training submit each checkpoint "
        "(`submit_evaluation`)",
        "watch",
    )
    eval_options = EvalOptions(**options)
    config = config_from_options(eval_options)
    if eval_options.out is None and eval_options.source is not None:
        raise ConfigError(
            "--out: expected a folder, which a repeated or requeued job continues, got none; add it"
        )
    return config, plan_cases(resolve_policies(config, ask=False)[0])
