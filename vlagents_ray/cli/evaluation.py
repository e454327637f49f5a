"""`vlagents-ray eval`: from a file or from options, serving what is to be served."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import yaml

from vlagents_ray.cli.console import errors, out
from vlagents_ray.cli.settings import parse_list, parse_settings
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.checkpoints import STEP, resolved
from vlagents_ray.serve.cluster import joined, running_server
from vlagents_ray.serve.files import own_settings, read_deployment, together, with_settings

if TYPE_CHECKING:
    from ray.serve.schema import ServeDeploySchema

    from vlagents_ray.evaluate import EvalConfig, PolicyConfig, Summary

Set = Annotated[list[str], typer.Option("--set", metavar="KEY=VALUE", help="A setting of the policy, repeatable.")]
Address = Annotated[
    str | None, typer.Option(help="A running Ray cluster ('auto' finds it); default: one for the run, on this machine.")
]
_FILE = (".yaml", ".yml")


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
    address: Address = None,
) -> None:
    """Evaluate policies: episodes in parallel, success rates with confidence intervals, videos.

    A file holds policies, their checkpoints, suites of environments, seeds; --out, --workers, --video, --record,
    --track, --retries and --resume win over it.
    """
    from vlagents_ray.evaluate import EvalConfig

    with errors():
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
        if what[0].endswith(_FILE):
            if beside := [*what[1:], *of_policy, *of_suite]:
                raise ConfigError(f"{what[0]} says what is evaluated; got {beside} beside it: write that there")
            fields = read_run(Path(what[0])) | running
        else:
            if policy is None or out_dir is None:
                raise ConfigError("want --policy and --out, or a file of runs (.yaml)")
            fields = {"policies": [of_policy], "suites": [{"envs": what} | of_suite], **running}
        config = EvalConfig.model_validate(fields)
        watching = _given(until=until, settle_s=settle, marker=marker)
        if watching and watch is None:
            raise ConfigError(f"got {sorted(watching)} without --watch")
        if dry_run and watch is not None:
            raise ConfigError("--dry-run and --watch exclude each other: nobody knows yet which steps there will be")
        if dry_run:
            from vlagents_ray.cli.forecasting import print_plan

            print_plan(config)
        elif watch is not None:
            from vlagents_ray.cli.watching import watch_training

            watch_training(config, watch, address, **watching)
        else:
            run_evaluation(config, address)


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


def run_evaluation(config: EvalConfig, address: str | None = None) -> None:
    """Serve the policies that are not at a URL, evaluate them all, print the table."""
    with served(config, address) as ready:
        evaluate_and_print(ready)


def evaluated(config: EvalConfig, address: str | None = None, *, only: tuple[int, int] | None = None) -> Summary:
    """Serve the policies that are not at a URL, and evaluate them all; `only` as in `evaluate`."""
    from vlagents_ray.evaluate import evaluate, progress_for

    with served(config, address) as ready:
        return evaluate(ready, progress=progress_for(out), only=only)


@contextlib.contextmanager
def served(config: EvalConfig, address: str | None = None) -> Iterator[EvalConfig]:
    """`config` with the URLs of its policies, those that are not at one being served for the length of the context."""
    from vlagents_ray.evaluate import check, most_cpus

    with contextlib.ExitStack() as stack:
        if address is not None:
            stack.enter_context(joined(address))
        config, parts = reached(config)
        check(config)  # what is wrong is said before anything starts
        if parts:
            # Ray's CPUs are bookkeeping here: the number of workers that the user asked for must fit.
            cpus = max(os.cpu_count() or 1, math.ceil(config.workers * most_cpus(config)))
            stack.enter_context(running_server(together(parts), address=address, num_cpus=cpus))
        yield config


def evaluate_and_print(config: EvalConfig) -> None:
    """Evaluate policies that are at their URLs; an interrupted evaluation prints what it has."""
    from vlagents_ray.evaluate import EvaluationInterrupted, evaluate, print_summary, progress_for

    try:
        summary = evaluate(config, progress=progress_for(out))
    except EvaluationInterrupted as interrupted:
        print_summary(out, interrupted.summary)
        raise
    print_summary(out, summary)


def reached(config: EvalConfig, *, ask: bool = True) -> tuple[EvalConfig, dict[str, ServeDeploySchema]]:
    """`config` with what its policies are and where; and by application those that are to be served there.

    A server at a URL is asked what it serves, unless `ask` is off.
    """
    parts: dict[str, ServeDeploySchema] = {}
    policies = [_reached(policy, parts, ask=ask) for policy in config.policies]
    return type(config).model_validate(config.model_dump(exclude_unset=True) | {"policies": policies}), parts


def _reached(policy: PolicyConfig, parts: dict[str, ServeDeploySchema], *, ask: bool) -> PolicyConfig:
    """`policy` with its URL and with what it is; one that is to be served joins `parts`."""
    url = policy.source if policy.source is not None and "://" in policy.source else policy.url
    if url is not None:
        return policy.model_copy(update={"url": url, "source": None} | (_found(policy, url) if ask else {}))
    if policy.source is None:
        raise ConfigError(f"policy {policy.name!r}: want `source`, a policy to serve, or the `url` of a server")
    part = deployed(policy, policy.source)
    own = own_settings(part.applications[0])
    name = policy.name if "name" in policy.model_fields_set else str(part.applications[0].args["policy"])
    application = re.sub(r"\W+", "-", name.rpartition(":")[2])
    if policy.steps and own.get(STEP) is None:  # the deployment's own is some step; what is recorded is the pattern
        part = with_settings(part, {STEP: policy.steps[0]}, steps=True)
    parts[application] = part
    found = {"name": name, "url": f"serve://{application}", "config": own, "checkpoint": resolved(own)}
    return policy.model_copy(update=found)


def deployed(policy: PolicyConfig, source: str) -> ServeDeploySchema:
    """The deployment of `source` with the settings of `policy`."""
    of_name = {"config": policy.config} if policy.config and not source.endswith(_FILE) else None
    return with_settings(read_deployment(source, of_name), policy.config, steps=bool(policy.steps))


def _found(policy: PolicyConfig, url: str) -> dict[str, Any]:
    """What the server says that it serves: a result belongs to that, not to an address."""
    from vlagents_ray import RemoteAgent

    if policy.config:
        raise ConfigError(f"policy {policy.name!r}: got {sorted(policy.config)}, but {url} has its settings already")
    with RemoteAgent(url) as agent:
        said = agent.metadata
    name = policy.name if "name" in policy.model_fields_set else said["policy"]
    return {"name": name, "config": said.get("config", {}), "checkpoint": said.get("checkpoint")}
