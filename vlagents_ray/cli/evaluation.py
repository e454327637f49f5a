"""`vlagents-ray eval`: from a file or from options, serving what is to be served."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import yaml

from vlagents_ray.cli.console import errors, fail, out
from vlagents_ray.cli.reaching import FILE, served
from vlagents_ray.cli.settings import parse_list, parse_settings, parse_time
from vlagents_ray.errors import ConfigError
from vlagents_ray.slurm.script import UNFINISHED

if TYPE_CHECKING:
    from vlagents_ray.evaluate import EvalConfig, Summary, WorkerConfig

Set = Annotated[list[str], typer.Option("--set", metavar="KEY=VALUE", help="A setting of the policy, repeatable.")]
Address = Annotated[
    str | None, typer.Option(help="A running Ray cluster ('auto' finds it); default: one for the run, on this machine.")
]


def evaluate_command(
    what: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE | ENV...",
            help="A file of runs (.yaml); or environments: maniskill/PushCube-v1, 'libero/*', …",
        ),
    ],
    policy: Annotated[
        str | None, typer.Option(help="A registered name, a deployment file, or the URL of a running server.")
    ] = None,
    out_dir: Annotated[Path | None, typer.Option("--out", help="Folder of the results.")] = None,
    episodes: Annotated[int | None, typer.Option(min=1, help="Episodes of each environment; default: 10.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Environments rolled out in parallel; default: 1.")] = None,
    worker_cpus: Annotated[
        float | None, typer.Option(min=0, help="CPUs of each worker, unless the file says how many; default: 0.5.")
    ] = None,
    worker_gpus: Annotated[
        float | None,
        typer.Option(min=0, help="GPUs likewise, to render on: 0.25 is a quarter of one; default: 0, in software."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Episode i uses seed + i; default: 0.")] = None,
    video: Annotated[str | None, typer.Option(help="none, failures (default) or all.")] = None,
    record: Annotated[
        str | None, typer.Option(help="Trajectories, to export and to replay: none (default), failures or all.")
    ] = None,
    track: Annotated[str, typer.Option(help="wandb, trackio, tensorboard, with commas between them.")] = "",
    resume: Annotated[bool, typer.Option(help="Go on with the results in --out.")] = False,
    execute: Annotated[int | None, typer.Option(min=1, help="Rows executed of each chunk; default: all.")] = None,
    retries: Annotated[
        int | None, typer.Option(min=0, help="Further attempts after an infrastructure failure; default: 3.")
    ] = None,
    settings: Set = [],  # noqa: B006 - typer reads it
    env_set: Annotated[
        list[str], typer.Option("--env-set", metavar="KEY=VALUE", help="An option of the environments: width=256.")
    ] = [],  # noqa: B006
    reset_set: Annotated[
        list[str],
        typer.Option("--reset-set", metavar="KEY=VALUE", help="An option of the policy's reset: checkpoint_step=9."),
    ] = [],  # noqa: B006
    watch: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Evaluate each checkpoint that a training run writes there, until Ctrl-C."),
    ] = None,
    until: Annotated[int | None, typer.Option(min=0, metavar="STEP", help="End --watch with this step.")] = None,
    settle: Annotated[
        float | None, typer.Option(min=0, help="With --watch: s that a checkpoint must not have changed; default: 10.")
    ] = None,
    marker: Annotated[
        str | None, typer.Option(metavar="NAME", help="With --watch: the file that the trainer writes in it when done.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print plan, count and estimated time; play nothing.")
    ] = False,
    end_at: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="Begin no episode that would not end by then: 2027-01-31T18:30, local time, or s since 1970.",
        ),
    ] = None,
    replica_per_gpu: Annotated[
        bool,
        typer.Option(
            "--replica-per-gpu",
            help="With --address: a policy has a replica on each GPU of the cluster, unless its deployment says more.",
        ),
    ] = False,
    address: Address = None,
) -> None:
    """Evaluate policies: episodes in parallel, success rates with confidence intervals, videos.

    A file holds policies, their checkpoints, suites of environments, seeds; --out, --workers, --video, --record,
    --track, --retries and --resume win over it.

    Exit status: 0 when every episode has its result, 75 when --end-at left some over (--resume goes on), 130 after
    Ctrl-C or SIGTERM (likewise), 2 for wrong settings, 1 for what else failed.
    """
    with errors():
        config = configured(
            what, policy, out_dir, episodes, workers, worker_cpus, worker_gpus, seed, video, record, track, resume,
            execute, retries, settings, env_set, reset_set,
        )  # fmt: skip
        watching = _given(until=until, settle_s=settle, marker=marker)
        if watching and watch is None:
            raise ConfigError(f"got {sorted(watching)} without --watch")
        if dry_run and watch is not None:
            raise ConfigError("--dry-run and --watch exclude each other: nobody knows yet which steps there will be")
        if end_at is not None and watch is not None:
            raise ConfigError("--end-at and --watch exclude each other: watching ends with --until, or by Ctrl-C")
        if replica_per_gpu and address is None:
            raise ConfigError("--replica-per-gpu: want --address, a cluster whose GPUs can be counted")
        if dry_run:
            from vlagents_ray.cli.forecasting import print_plan

            print_plan(config)
        elif watch is not None:
            from vlagents_ray.cli.watching import watch_training

            watch_training(config, watch, address, **watching)
        else:
            end = None if end_at is None else parse_time(end_at, "--end-at")
            run_evaluation(config, address, end_at=end, replica_per_gpu=replica_per_gpu)


def configured(
    what: list[str],
    policy: str | None,
    out_dir: Path | None,
    episodes: int | None,
    workers: int | None,
    worker_cpus: float | None,
    worker_gpus: float | None,
    seed: int | None,
    video: str | None,
    record: str | None,
    track: str,
    resume: bool,
    execute: int | None,
    retries: int | None,
    settings: list[str],
    env_set: list[str],
    reset_set: list[str],
) -> EvalConfig:
    """What these options of `eval`, by the names that the command gives them, ask for."""
    from vlagents_ray.evaluate import EvalConfig

    running = _given(
        out=out_dir, workers=workers, video=video, record=record, track=parse_list(track), retries=retries,
        resume=resume,
    )  # fmt: skip
    of_policy = _given(
        source=policy,
        execute=execute,
        config=parse_settings(settings, "--set"),
        options=parse_settings(reset_set, "--reset-set"),
    )
    of_suite = _given(episodes=episodes, env_options=parse_settings(env_set, "--env-set"))
    if seed is not None:
        of_suite["seeds"] = [seed]
    if what[0].endswith(FILE):
        if beside := [*what[1:], *of_policy, *of_suite]:
            raise ConfigError(f"{what[0]} says what is evaluated; got {beside} beside it: write that there")
        fields = read_run(Path(what[0])) | running
    else:
        if policy is None or out_dir is None:
            raise ConfigError("want --policy and --out, or a file of runs (.yaml)")
        fields = {"policies": [of_policy], "suites": [{"envs": what} | of_suite], **running}
    return _with_resources(EvalConfig.model_validate(fields), _given(cpus=worker_cpus, gpus=worker_gpus))


def _with_resources(config: EvalConfig, resources: dict[str, float]) -> EvalConfig:
    """With these for each worker, where nobody has said what that one takes."""
    if not resources:
        return config

    def filled(worker: WorkerConfig) -> WorkerConfig:
        unsaid = {name: value for name, value in resources.items() if name not in worker.model_fields_set}
        return worker.model_copy(update=unsaid)

    suites = [
        suite if suite.worker is None else suite.model_copy(update={"worker": filled(suite.worker)})
        for suite in config.suites
    ]
    return config.model_copy(update={"worker": filled(config.worker), "suites": suites})


def _given(**options: Any) -> dict[str, Any]:
    """The options that say something."""
    # 0 does, though it equals False.
    return {name: value for name, value in options.items() if value not in (None, {}, []) and value is not False}


def read_run(file: Path) -> dict[str, Any]:
    """What a file of runs says; results go to runs/NAME unless it names a folder."""
    if not file.is_file():
        raise ConfigError(f"file of runs {str(file)!r} does not exist")
    try:
        document = yaml.safe_load(file.read_text())
    except yaml.YAMLError as error:
        raise ConfigError(f"{file}: not YAML ({error})") from error
    if not isinstance(document, dict):
        raise ConfigError(f"{file}: got {type(document).__name__}, want a mapping with `policies` and `suites`")
    return {"out": Path("runs") / file.stem} | document


def run_evaluation(
    config: EvalConfig, address: str | None = None, *, end_at: float | None = None, replica_per_gpu: bool = False
) -> None:
    """Serve the policies that are not at a URL, evaluate them all, print the table; `end_at` as in `evaluate`."""
    with served(config, address, replica_per_gpu=replica_per_gpu) as ready:
        evaluate_and_print(ready, end_at)


def evaluated(config: EvalConfig, address: str | None = None, *, only: tuple[int, int] | None = None) -> Summary:
    """Serve the policies that are not at a URL, and evaluate them all; `only` as in `evaluate`."""
    from vlagents_ray.evaluate import evaluate, progress_for

    with served(config, address) as ready:
        return evaluate(ready, progress=progress_for(out), only=only)


def evaluate_and_print(config: EvalConfig, end_at: float | None = None) -> None:
    """Evaluate policies that are at their URLs; an interrupted evaluation prints what it has."""
    from vlagents_ray.evaluate import EvaluationInterrupted, OutOfTime, evaluate, print_summary, progress_for

    try:
        summary = evaluate(config, progress=progress_for(out), end_at=end_at)
    except EvaluationInterrupted as interrupted:
        print_summary(out, interrupted.summary)
        if isinstance(interrupted, OutOfTime):
            fail(str(interrupted), UNFINISHED)
        raise
    print_summary(out, summary)
