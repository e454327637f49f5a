"""`vlagents-ray eval`: evaluations from a run file or from options."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vlagents_ray.bounds import (
    MOST_CPUS,
    MOST_EPISODES,
    MOST_RETRIES,
    MOST_ROWS,
    MOST_S,
    MOST_SEED,
    MOST_STEP,
    MOST_WORKERS,
)
from vlagents_ray.cli.console import errors, fresh
from vlagents_ray.cli.options import (
    Address,
    ConfigDir,
    Live,
    LiveAt,
    changed_settings,
    command_of,
    find_policy,
    finite,
    parse_list,
    parse_time,
    read_run_file,
)
from vlagents_ray.cli.ray_session import quiet_ray
from vlagents_ray.errors import ConfigError
from vlagents_ray.naming import plain
from vlagents_ray.overrides import (
    YAML_SUFFIXES,
    Override,
    find_file,
    parse_overrides,
    parse_settings,
)

if TYPE_CHECKING:
    from pydantic import BaseModel

    from vlagents_ray.evaluate import EvalConfig, WorkerConfig


@dataclass(frozen=True)
class EvalOptions:
    """The options of `vlagents-ray eval`.

    An option that is a field of `EvalConfig`, or of its policy, suite or worker, has the field's
    name here.
    """

    targets: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE | ENV...",
            help="A run file (.yaml), or environments such as tabletop or 'libero/*'.",
        ),
    ]
    source: Annotated[
        str | None,
        typer.Option(
            "--policy",
            metavar="POLICY",
            help="The policy: a registered name, a deployment file, or a URL.",
        ),
    ] = None
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FOLDER",
            help="Folder of the results; default: runs/NAME for the file NAME.yaml, otherwise a "
            "new folder runs/ENV-TIME.",
        ),
    ] = None
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MOST_EPISODES,
            metavar="N",
            help="Number of episodes in each environment; default: 10.",
        ),
    ] = None
    workers: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=MOST_WORKERS,
            metavar="N",
            help="Number of environments that run in parallel. 0 runs them in this process, "
            "without Ray; default: 0 for a short evaluation, otherwise 1.",
        ),
    ] = None
    cpus: Annotated[
        float | None,
        typer.Option(
            "--worker-cpus",
            metavar="N",
            min=0,
            max=MOST_CPUS,
            callback=finite,
            help="Number of CPUs of each worker, unless the file sets it; default: 0.5.",
        ),
    ] = None
    gpus: Annotated[
        float | None,
        typer.Option(
            "--worker-gpus",
            metavar="N",
            min=0,
            max=MOST_CPUS,
            callback=finite,
            help="Number of GPUs on which each worker renders, such as 0.25; default: 0, which "
            "renders in software.",
        ),
    ] = None
    seeds: Annotated[
        int | None,
        typer.Option(
            "--seed",
            metavar="N",
            min=0,
            max=MOST_SEED,
            help="Seed of the first episode. Episode i uses seed + i; default: 0.",
        ),
    ] = None
    video: Annotated[
        str | None,
        typer.Option(
            metavar="none|failures|all",
            help="Episodes whose video is written; default: none.",
        ),
    ] = None
    record: Annotated[
        str | None,
        typer.Option(
            metavar="none|failures|all",
            help="Episodes whose trajectory is written; default: none.",
        ),
    ] = None
    track: Annotated[
        str,
        typer.Option(metavar="NAMES", help="Trackers, such as wandb, separated by commas."),
    ] = ""
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue the evaluation in the folder --out.")
    ] = False
    accept_changes: Annotated[
        bool,
        typer.Option(
            "--accept-changes",
            help="With --resume: continue even if files or weights have changed. The report lists "
            "the changes.",
        ),
    ] = False
    execute: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MOST_ROWS,
            metavar="N",
            help="Number of rows of each chunk that are executed; default: all.",
        ),
    ] = None
    retries: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=MOST_RETRIES,
            metavar="N",
            help="Number of further attempts at an episode that infrastructure lost; default: 3.",
        ),
    ] = None
    config: Annotated[
        list[str],
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Set a setting of the policy, or a key of the run file, such as "
            "suites.0.episodes=5. +KEY=VALUE adds a key, and ~KEY removes one. May be repeated.",
        ),
    ] = field(default_factory=list)
    config_dir: ConfigDir = None
    env_options: Annotated[
        list[str],
        typer.Option(
            "--env-set",
            metavar="KEY=VALUE",
            help="An option of the environments, such as width=256. May be repeated.",
        ),
    ] = field(default_factory=list)
    options: Annotated[
        list[str],
        typer.Option(
            "--reset-set",
            metavar="KEY=VALUE",
            help="An option of the policy's reset, such as weights=follow. May be repeated.",
        ),
    ] = field(default_factory=list)
    watch: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Evaluate each checkpoint that a training run writes into this folder, until "
            "Ctrl-C.",
        ),
    ] = None
    until: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=MOST_STEP,
            metavar="STEP",
            help="With --watch: end after the checkpoint of this step.",
        ),
    ] = None
    settle_s: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=MOST_S,
            callback=finite,
            metavar="S",
            help="With --watch: treat a checkpoint as complete after this number of seconds "
            "without changes; default: 10.",
        ),
    ] = None
    marker: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="With --watch: the file that the trainer writes last into a checkpoint.",
        ),
    ] = None
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Print the plan and the remaining time, without running episodes."
        ),
    ] = False
    end_at: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="Start no episode that would end after this time: 2027-01-31T18:30, or seconds "
            "since 1970.",
        ),
    ] = None
    replica_per_gpu: Annotated[
        bool,
        typer.Option(
            "--replica-per-gpu",
            help="With --address: run a replica of the policy on each GPU of the cluster.",
        ),
    ] = False
    arm: Annotated[
        str | None,
        typer.Option(
            "--robot",
            metavar="MODULE:CLASS",
            help="Run the trials of the file on a real robot of this class. The operator resets "
            "the scene and judges each trial, without knowing which policy runs.",
        ),
    ] = None
    operator: Annotated[
        str | None,
        typer.Option(
            metavar="page|terminal",
            help="With --robot: where the operator answers questions; default: page.",
        ),
    ] = None
    unblind: Annotated[
        bool,
        typer.Option(
            "--unblind",
            help="With --robot: write the results so far, with the names of the policies.",
        ),
    ] = False
    address: Address = None
    live: Live = False
    live_at: LiveAt = None

    def options_set(self, *names: str) -> list[str]:
        """Return the names of the options that are set, as they are written on the command line.

        Args:
            names: The names of the fields of the options. The value 0 counts as set, False does
                not.
        """
        options = []
        for name in names:
            value = getattr(self, name)
            if value or (value == 0 and value is not False):
                options.append(f"--{name.replace('_', '-')}")
        return options

    def require_together(self, *, on_robot: bool) -> None:
        """Check the combination of the options.

        Args:
            on_robot: Whether the evaluation runs on a real robot.

        Raises:
            ConfigError: An option needs another option that is not set, or two options exclude each
                other.
        """
        watch_options = self.options_set("until", "settle_s", "marker")
        if self.watch is None and watch_options:
            raise ConfigError(
                f"expected --watch with {watch_options}, got none; add --watch, or leave the "
                f"others out"
            )
        if self.dry_run and self.watch is not None:
            raise ConfigError(
                "--dry-run and --watch exclude each other: the steps of the training are not "
                "known in advance"
            )
        if self.end_at is not None and self.watch is not None:
            raise ConfigError(
                "--end-at and --watch exclude each other: watching ends with --until, or by Ctrl-C"
            )
        if self.replica_per_gpu and self.address is None:
            raise ConfigError(
                "--replica-per-gpu: expected --address of a cluster, got none; add it"
            )
        if self.dry_run and self.options_set("live", "live_at"):
            raise ConfigError(
                "--dry-run and --live exclude each other: a dry run has no episodes to watch"
            )

        robot_options = self.options_set("operator", "unblind")
        if not on_robot and robot_options:
            raise ConfigError(
                f"expected --robot with {robot_options}, got none; add --robot, or leave the "
                f"others out"
            )
        excluded = self.options_set("watch", "dry_run", "end_at", "track", "live", "live_at")
        if on_robot and excluded:
            raise ConfigError(f"--robot and {excluded} exclude each other")
        if self.operator not in (None, "page", "terminal"):
            raise ConfigError(f"--operator: expected 'page' or 'terminal', got {self.operator!r}")


_PANELS = {
    "What to run": (
        "source",
        "config",
        "config_dir",
        "episodes",
        "seeds",
        "execute",
        "env_options",
        "options",
        "retries",
    ),
    "Results": (
        *("out", "resume", "accept_changes", "video", "record"),
        *("track", "live", "live_at"),
    ),
    "Workers and cluster": ("workers", "cpus", "gpus", "address", "replica_per_gpu"),
    "Time": ("dry_run", "end_at"),
    "Checkpoints of a training run": ("watch", "until", "settle_s", "marker"),
    "A real robot": ("arm", "operator", "unblind"),
}


@command_of(EvalOptions, _PANELS)
def evaluate_command(options: EvalOptions) -> None:
    """Evaluate policies: run episodes in parallel, and report success rates with confidence
    intervals and videos.

    A run file contains policies, their checkpoints, suites of environments and seeds. --set
    changes its keys. --out, --workers, --video, --record, --track, --retries and --resume override
    them.

    Exit status: 0 if every episode has a result; 75 if episodes are left because of --end-at, 130
    if the evaluation was interrupted (continue both with --resume); 2 for invalid settings; 3 if an
    error of the policy ended every episode of a case; 1 for any other failure, and if
    infrastructure lost an episode (--resume runs it again).
    """
    with errors():
        config = config_from_options(options)
        on_robot = config.real_robot is not None
        options.require_together(on_robot=on_robot)
        from vlagents_ray.cli.evaluation import (
            live_address,
            print_plan,
            run_evaluation,
            run_on_robot,
            watch_training,
        )

        address = options.address
        page = live_address(options.live_at) if options.live or options.live_at else None
        if on_robot:
            run_on_robot(
                config, address, operator=options.operator or "page", unblinded=options.unblind
            )
        elif options.dry_run:
            with quiet_ray(None):
                print_plan(config, address)
        elif options.watch is not None:
            settle_s = 10.0 if options.settle_s is None else options.settle_s
            watch_training(
                config,
                options.watch,
                address,
                until=options.until,
                settle_s=settle_s,
                marker=options.marker,
                live=page,
            )
        else:
            end = None if options.end_at is None else parse_time(options.end_at, "--end-at")
            run_evaluation(
                config, address, end_at=end, replica_per_gpu=options.replica_per_gpu, live=page
            )


def config_from_options(options: EvalOptions) -> EvalConfig:
    """Build the configuration of an evaluation from the options of `vlagents-ray eval`.

    Raises:
        ConfigError: An option is missing, or contradicts the run file.
        pydantic.ValidationError: A value is wrong.
    """
    from vlagents_ray.evaluate import EvalConfig, PolicyConfig, SuiteConfig, WorkerConfig

    targets = options.targets
    target = targets[0]
    if options.source is None:  # otherwise the targets are environments
        target = find_file(target, options.config_dir)
    has_file = target.endswith(YAML_SUFFIXES)

    overrides = parse_overrides(options.config, "--set")
    source = options.source and find_policy(options.source, options.config_dir)
    parsed = {
        **vars(options),
        "track": parse_list(options.track),
        "source": source,
        "config": {} if has_file else changed_settings(source, overrides),
        "options": parse_settings(options.options, "--reset-set"),
        "env_options": parse_settings(options.env_options, "--env-set"),
        "seeds": None if options.seeds is None else [options.seeds],
    }
    run = _settings_of(parsed, EvalConfig)
    policy = _settings_of(parsed, PolicyConfig)
    suite = _settings_of(parsed, SuiteConfig)
    worker = _settings_of(parsed, WorkerConfig)

    if has_file:
        excess = [*targets[1:], *policy, *suite]
        if excess:
            raise ConfigError(
                f"expected only {target} to define the evaluation, got {excess} as well; write "
                f"these settings in the file, or change the file with --set"
            )
        document = read_run(Path(target), overrides)
        fields = _with_files_found(document, options.config_dir) | run
    else:
        if "source" not in policy:
            raise ConfigError("expected --policy, got none; add it, or give a plan (.yaml)")
        if "out" not in run:
            run["out"] = _new_folder(target, resume=options.resume)
        fields = {"policies": [policy], "suites": [{"envs": list(targets)} | suite], **run}

    if options.arm is not None:
        fields["robot"] = {**(fields.get("robot") or {}), "arm": options.arm}
    config = EvalConfig.model_validate(fields)

    for configured in config.policies:
        if configured.source is not None and configured.url is not None:
            raise ConfigError(
                f"policy {configured.name!r}: expected `source`, a policy to serve, or the `url` "
                "of a server, got both; leave one of them out"
            )
    return _with_worker(config, worker) if worker else config


def _new_folder(env: str, *, resume: bool) -> Path:
    """Return a folder for the results of an evaluation without a run file and without --out; its
    name consists of the environment and the time.

    Raises:
        ConfigError: --resume is set, which needs the folder in --out.
    """
    if resume:
        raise ConfigError(
            "--resume: expected --out, the folder of the results to continue, got none; add it"
        )
    return fresh(Path("runs") / f"{plain(env)}-{time.strftime('%Y%m%d-%H%M%S')}")


def _with_files_found(document: dict[str, Any], config_dir: Path | None) -> dict[str, Any]:
    """Return the settings of a run file, in which names of deployment files in the folder
    `config_dir` are replaced with their paths.
    """
    policies = document.get("policies")
    if config_dir is None or not isinstance(policies, list):
        return document

    changed = []
    for policy in policies:
        source = policy.get("source") if isinstance(policy, dict) else None
        if isinstance(source, str) and source.endswith(YAML_SUFFIXES):
            changed.append({**policy, "source": find_file(source, config_dir)})
        else:
            changed.append(policy)
    return {**document, "policies": changed}


def _with_worker(config: EvalConfig, options: dict[str, Any]) -> EvalConfig:
    """Return the configuration with the workers' options added, except for options that it already
    sets.
    """

    def fill(worker: WorkerConfig) -> WorkerConfig:
        """Return the settings of a worker with the missing options added."""
        missing = {}
        for name, value in options.items():
            if name not in worker.model_fields_set:
                missing[name] = value
        return worker.model_copy(update=missing)

    suites = []
    for suite in config.suites:
        if suite.worker is None:
            suites.append(suite)
        else:
            suites.append(suite.model_copy(update={"worker": fill(suite.worker)}))
    return config.model_copy(update={"worker": fill(config.worker), "suites": suites})


def _settings_of(options: dict[str, Any], model: type[BaseModel]) -> dict[str, Any]:
    """Return the options that are fields of `model` and are set."""
    selected = {}
    for name in model.model_fields:
        value = options.get(name)
        # 0 counts as set, although it equals False.
        if value not in (None, {}, []) and value is not False:
            selected[name] = value
    return selected


def read_run(file: Path, overrides: Sequence[Override] = ()) -> dict[str, Any]:
    """Read a run file, apply `overrides`, and return the settings.

    Raises:
        ConfigError: The file does not exist or is not a mapping, or a change is not possible.
    """
    return read_run_file(file, "run file", "`policies` and `suites`", overrides)
