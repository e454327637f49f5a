"""The modes of an evaluation (in simulation, as a printed plan, of a running training, on a robot),
and the live page of `--live`.
"""

from __future__ import annotations

import contextlib
import datetime
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import urlsplit

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from vlagents_ray.cli.console import fail, out
from vlagents_ray.cli.exit_status import OUT_OF_TIME
from vlagents_ray.cli.listing import require_packages
from vlagents_ray.cli.policies import (
    Served,
    planned_workers,
    policy_deployment,
    resolve_policies,
    served,
)
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.evaluate import (
    EvalConfig,
    EvaluationInterrupted,
    OutOfTime,
    Progress,
    Results,
    Summary,
    print_summary,
    progress_for,
)
from vlagents_ray.evaluate.checkpoint_watcher import CheckpointWatcher, rounds
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase, plan_cases
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan, resolve
from vlagents_ray.evaluate.report.results_document import ProgressDocument, ResultsDocument
from vlagents_ray.evaluate.report.terminal import LineProgress
from vlagents_ray.evaluate.results.database import FILE, is_locked
from vlagents_ray.evaluate.results.summary import errors_of_policies, failing_cases, summarize
from vlagents_ray.evaluate.run import check_results, evaluate_plan
from vlagents_ray.policies.base.checkpoint import CHECKPOINT, STEP
from vlagents_ray.ray_tools.private import node_of_this_process
from vlagents_ray.registry import function_in_plugin, registered_class
from vlagents_ray.serve.access.api_keys import load_keys, require_watch_keys
from vlagents_ray.serve.launch.deployment_file import own_settings
from vlagents_ray.serve.ports import LOOPBACK, is_free

POLICY_ERRORS = 3  # exit status: an error of the policy ended every episode of a case
LOOK_S = 1.0  # the period at which the folder of checkpoints is read
_PORT = 8050  # preferred port of the live page


def live_address(at: str | None) -> tuple[str, int]:
    """Return the address of the live page.

    Args:
        at: The value of `--live-at`, "HOST:PORT"; None for `--live` alone.

    Returns:
        The host and the port; port 0 selects a free port.

    Raises:
        ConfigError: The plug-in with the page is not installed, or other machines could reach the
            page without a key.
    """
    _server_of_page()
    if at is None:
        return LOOPBACK, _PORT if is_free(LOOPBACK, _PORT) else 0
    try:
        url = urlsplit(f"//{at}")
        host, port = url.hostname, url.port
    except ValueError:
        host = port = None
    if host is None or port is None or url.netloc != at:
        raise ConfigError(f"--live-at: expected HOST:PORT, as in 127.0.0.1:{_PORT}, got {at!r}")
    require_watch_keys(host, load_keys())  # raised before a policy is served
    return host, port


@contextlib.contextmanager
def shown_progress(
    plan: ResolvedPlan, live: tuple[str, int] | None, *, goes_on: bool = False
) -> Iterator[Progress]:
    """Show the progress of an evaluation on the terminal and on the live page.

    Without workers, the terminal shows plain lines, since a table that is redrawn would disturb a
    debugger.

    Args:
        plan: The plan of the evaluation. If it needs Ray, Ray must already be running.
        live: The address of the live page; None for no page.
        goes_on: Whether more evaluations with the same folder of results follow.

    Yields:
        The progress, for `evaluate_plan`.
    """
    progress = progress_for(out) if plan.workers else LineProgress(out)
    if live is None:
        yield progress
        return

    document = ProgressDocument(plan.out, progress, goes_on=goes_on)
    apps: list[str] = []
    if node_of_this_process() is not None:
        urls = [str(policy.url) for policy in plan.policies]
        apps = [url.removeprefix("serve://") for url in urls if url.startswith("serve://")]
    with _page(document, apps, live):
        try:
            yield document
        except Exception as error:
            if not isinstance(error, typer.Exit):
                document.fail(str(error))
            raise
        finally:
            document.close()


def follow(results: Path, address: tuple[str, int]) -> None:
    """Serve the live page of an evaluation or a training of another process, until Ctrl-C.

    Args:
        results: The folder into which the other process writes its results.
        address: The host and port of the page.
    """
    with _page(ResultsDocument(results), [], address), contextlib.suppress(KeyboardInterrupt):
        threading.Event().wait()


def _server_of_page() -> Callable[..., AbstractContextManager[str]]:
    """Return the function that serves the live page, `serve_evaluation` of its plug-in."""
    target = "vlagents_ray_live.live_evaluation_page:serve_evaluation"
    server: Callable[..., AbstractContextManager[str]] = function_in_plugin(
        "the live page of evaluations", target, "vlagents-ray-live"
    )
    return server


@contextlib.contextmanager
def _page(
    document: ResultsDocument, apps: Sequence[str], address: tuple[str, int]
) -> Iterator[None]:
    """Serve the live page within the context, and print its URL."""
    serve = _server_of_page()
    with serve(document, apps, address, load_keys()) as url:
        out.print(f"live: {url}")
        yield


def run_evaluation(
    config: EvalConfig,
    address: str | None = None,
    *,
    end_at: float | None = None,
    replica_per_gpu: bool = False,
    live: tuple[str, int] | None = None,
) -> None:
    """Serve the policies that are not at a URL, evaluate all policies, and print the table.

    Args:
        config: The evaluation.
        address: The Ray cluster, see `served`.
        end_at: The time after which no episode ends, as in `evaluate_plan`.
        replica_per_gpu: Whether each policy has a replica on each GPU of the cluster.
        live: The host and port of the live page; None for no page.
    """
    # The page also shows the sessions of replicas, which exist only with Ray.
    if live is not None and config.workers is None:
        config = config.model_copy(update={"workers": 1})

    with contextlib.ExitStack() as stack:
        try:
            running = stack.enter_context(served(config, address, replica_per_gpu=replica_per_gpu))
        except KeyboardInterrupt as error:
            raise KeyboardInterrupt(
                "interrupted while Ray and the policies started; no episode began: repeat the "
                "command"
            ) from error
        progress = stack.enter_context(shown_progress(running.plan, live))
        summary = evaluate_and_print(running, progress, end_at)

    require_results(running.plan.cases, summary)


def play_one(
    config: EvalConfig, address: str | None, only: tuple[int, int], *, rows: int | None = None
) -> Summary:
    """Serve the policy, unless it is at a URL, and run one of its episodes.

    Args:
        config: The evaluation of one policy in one environment.
        address: The Ray cluster, see `served`.
        only: The number and the seed of the episode, as in `evaluate`.
        rows: The number of rows of each forward pass, as in `served`.
    """
    with (
        served(config, address, rows=rows) as running,
        shown_progress(running.plan, None) as progress,
    ):
        return evaluate_plan(
            running.plan,
            agent_factory=running.agents,
            swaps=running.swaps,
            progress=progress,
            only=only,
        )


def evaluate_and_print(running: Served, progress: Progress, end_at: float | None = None) -> Summary:
    """Evaluate policies, and print the table of the results, even if the evaluation is
    interrupted.

    Args:
        running: The evaluation and its policies.
        progress: Shows the progress.
        end_at: The time after which no episode ends, as in `evaluate_plan`.

    Returns:
        The summary of the results.
    """
    try:
        summary = evaluate_plan(
            running.plan,
            agent_factory=running.agents,
            swaps=running.swaps,
            progress=progress,
            end_at=end_at,
        )
    except PolicyFailed as error:
        results = Results.load(running.plan.out)
        if not failing_cases(results):
            raise
        print_summary(out, summarize(results))
        fail(str(error), POLICY_ERRORS)
    except EvaluationInterrupted as interrupted:
        print_summary(out, interrupted.summary)
        if isinstance(interrupted, OutOfTime):
            fail(str(interrupted), OUT_OF_TIME)
        raise
    print_summary(out, summary)
    return summary


def require_results(cases: Sequence[EvalCase], summary: Summary) -> None:
    """End the command with status 3 if an error of the policy ended every episode of one of these
    cases, and with status 1 if infrastructure lost an episode.

    Args:
        cases: The cases that this command has planned; other cases are ignored.
        summary: The summary of the results.
    """
    planned = {case.fingerprint for case in cases}
    results = [case for case in summary.results.cases if case.case_id in planned]

    failing = failing_cases(summary.results.among(results))
    if failing:
        (_, _, error), _ = errors_of_policies(summary.results.among(failing))[0]
        names = ", ".join(f"{case.policy_id} in {case.task}" for case in failing)
        fail(
            f"every episode ended with an error of the policy: {names}; the first error: "
            f"{error.strip()}",
            POLICY_ERRORS,
        )

    missing = sum(case.missing for case in results)
    if not missing:
        return

    lost_attempts = []
    for case in results:
        lost_attempts += [attempt for attempt in case.attempts if not attempt.retried]
    reason = ""
    if lost_attempts:
        last = max(lost_attempts, key=lambda attempt: attempt.at)
        first_line = last.error.strip().partition("\n")[0]
        reason = f", the last one to {last.code}: {first_line}"
    fail(
        f"{missing} of {sum(case.planned for case in results)} episodes have no result: lost to "
        f"infrastructure{reason}; the report lists every attempt under Errors, --resume tries them "
        "again",
        1,
    )


def watch_training(
    config: EvalConfig,
    folder: Path,
    address: str | None = None,
    *,
    until: int | None = None,
    settle_s: float = 10.0,
    marker: str | None = None,
    live: tuple[str, int] | None = None,
) -> None:
    """Evaluate each checkpoint of a running training as soon as the checkpoint is complete.

    All results are in one folder, and one server loads the checkpoints one after another. Policies
    without `{step}` are evaluated in the first round. The evaluation ends after the step `until`,
    or by Ctrl-C; it can be resumed. An episode without a result ends the command with status 1,
    after the last round.

    Args:
        config: The evaluation, in which the checkpoint of one policy contains `{step}`.
        folder: The folder into which the training writes checkpoints.
        address: The Ray cluster, see `served`.
        until: The last step; None for no limit.
        settle_s: The time without changes after which a checkpoint is complete, s.
        marker: The file that the trainer writes last into a checkpoint.
        live: The host and port of the live page; None for no page.

    Raises:
        ConfigError: The folder has results and `resume` is False, or no policy has `{step}` in its
            checkpoint, or watching ended without a checkpoint.
    """
    trained, pattern = _trained_policy(config)
    # Raise errors of the plan now, not at the first checkpoint.
    if (config.out / FILE).is_file() and not config.resume:
        raise ConfigError(
            f"{config.out} already has results: resume them (--resume), or choose another out "
            "folder"
        )
    if address is None:
        _, deployments = resolve_policies(_with_steps(config, trained, [0]), ask=False)
        for deployment in deployments.values():
            require_packages(deployment)

    watcher = CheckpointWatcher(pattern, folder, settle_s=settle_s, marker=marker)
    printed: dict[int, str] = {}  # the last printed reason for waiting, by step

    def pause() -> None:
        """Print the reasons why steps are not evaluated yet, and wait until the next reading of the
        folder.
        """
        for step, reason in watcher.waiting().items():
            if printed.get(step) != reason:
                printed[step] = reason
                out.print(f"step {step}: not yet: {reason}")
        threading.Event().wait(LOOK_S)

    suffix = "" if watcher.folder.is_dir() else ", which does not exist yet"
    out.print(f"watching {watcher.folder}{suffix}")
    rounds_of_steps = rounds(watcher, until, pause)
    first = next(rounds_of_steps, None)
    if first is None:
        raise ConfigError(
            f"{watcher.folder}: watching ended without a checkpoint; still waiting: "
            f"{watcher.waiting()}"
        )

    workers = 1 if config.workers is None else config.workers  # 1: a training run is long
    planned = _with_steps(config, trained, first).model_copy(update={"workers": workers})
    with contextlib.ExitStack() as stack:
        running = stack.enter_context(served(planned, address))
        plan = running.plan
        if plan.workers:
            from vlagents_ray.evaluate.workers.cluster import ray_cluster

            stack.enter_context(ray_cluster(plan))

        progress = stack.enter_context(shown_progress(plan, live, goes_on=True))
        summary = evaluate_and_print(running, progress)
        cases = [*plan.cases]
        for steps in rounds_of_steps:
            settings = _with_steps(plan.settings, trained, steps)
            later = resolve(settings.model_copy(update={"resume": True}))
            cases += later.cases
            summary = evaluate_and_print(replace(running, plan=later), progress)

    require_results(cases, summary)


def _trained_policy(config: EvalConfig) -> tuple[int, str]:
    """Return the index of the trained policy, and the pattern of its checkpoints."""
    patterns = {}
    for index, policy in enumerate(config.policies):
        if policy.source is None or "://" in policy.source:  # a running server has one checkpoint
            continue
        deployment = policy_deployment(policy, policy.source, step_follows=True)
        checkpoint = own_settings(deployment.applications[0]).get(CHECKPOINT)
        if isinstance(checkpoint, str) and STEP in checkpoint:
            patterns[index] = checkpoint

    if len(patterns) != 1:
        raise ConfigError(
            f"--watch: expected {STEP} in the checkpoint of one policy that this command serves, "
            f"such as checkpoint: /runs/a/{STEP}, got {len(patterns)} such policies"
        )
    [(index, pattern)] = patterns.items()
    if config.policies[index].steps:
        raise ConfigError(
            f"policy {config.policies[index].name!r}: expected no `steps` with --watch, which "
            f"finds the steps itself, got some; leave them out"
        )
    return index, pattern


def _with_steps(config: EvalConfig, index: int, steps: list[int]) -> EvalConfig:
    """Return the evaluation with these checkpoint steps of the policy at `index`."""
    policies = list(config.policies)
    policies[index] = policies[index].model_copy(update={"steps": steps})
    return config.model_copy(update={"policies": policies})


def run_on_robot(
    config: EvalConfig, address: str | None, *, operator: str, unblinded: bool
) -> None:
    """Serve the policies that are not at a URL, run the trials on a robot, and print the table.

    Args:
        config: The evaluation, with the settings of the robot.
        address: The Ray cluster, see `served`.
        operator: Where the operator answers questions, "page" or "terminal".
        unblinded: Whether to run no trials, and only print the results so far, with the names of
            the policies.
    """
    from vlagents_ray.evaluate.robot import (
        PageOperator,
        TerminalOperator,
        play_trials,
        require_trials,
        unblind,
    )

    if unblinded:
        key = None if config.robot is None else config.robot.key
        print_summary(out, unblind(config.out, key))
        return

    require_trials(config)  # before any process starts
    with served(config, address) as running, contextlib.ExitStack() as stack:
        plan = running.plan
        if operator == "terminal":
            summary = play_trials(plan, TerminalOperator())
        else:
            page = stack.enter_context(PageOperator(out.print))
            summary = play_trials(plan, page)
    print_summary(out, summary)


@dataclass(frozen=True, slots=True)
class Forecast:
    """The remaining episodes of a case, and the mean time of an episode."""

    case: EvalCase
    finished: int  # the number of planned episodes that are finished
    remaining: int  # the number of episodes to run; 0 if the case has stopped early
    seconds: float | None  # mean time of the policy's episodes in the env, s; None if unknown


def print_plan(config: EvalConfig, address: str | None = None) -> None:
    """Print a row for each case of an evaluation, and the totals, without serving a policy, running
    an episode or writing a file.

    Args:
        config: The evaluation.
        address: The Ray cluster, see `served`.

    Raises:
        ConfigError: The evaluation could not run, or contradicts the results in its folder.
    """
    for tracker in config.track:
        registered_class("trackers", tracker)  # raises an error for an unknown name

    resolved, deployments = resolve_policies(config, ask=False)
    workers = planned_workers(config, deployments, address)
    results = None
    if (resolved.out / FILE).is_file():
        # The plan of a run that has locked the folder was compared when the run began.
        if not is_locked(resolved.out):
            check_results(resolve(resolved))
        results = Results.load(resolved.out)
    forecast = forecasts(plan_cases(resolved), results)
    out.print(_forecast_table(forecast))
    _print_sums(forecast, resolved.out, workers)


def _print_sums(forecast: Sequence[Forecast], folder: Path, workers: int) -> None:
    """Print the number of cases and episodes, and the estimated time."""
    cases = [row.case for row in forecast]
    policies = len({case.policy_id for case in cases})
    envs = len({(case.suite.name, case.env) for case in cases})
    factors = f"{counted(policies, 'policy', 'policies')} x {counted(envs, 'environment')}"
    out.print(f"{counted(len(forecast), 'case')}: {factors}")

    planned = sum(case.planned for case in cases)
    finished = sum(row.finished for row in forecast)
    remaining = sum(row.remaining for row in forecast)
    out.print(
        f"{counted(planned, 'episode')}: {finished} finished in {folder}, {remaining} remaining"
    )

    # All workers take episodes from one queue, so they finish at most one episode's time apart.
    total_s = sum(row.remaining * (row.seconds or 0.0) for row in forecast)
    seconds = total_s / max(1, min(workers, remaining))
    time = _time(seconds)

    unknown = sum(row.seconds is None for row in forecast)
    if unknown == len(forecast):
        time = "unknown"
    elif unknown:
        time = f"at least {time}"
    without_episodes = ""
    if unknown:
        cases_in_total = counted(len(forecast), "case")
        without_episodes = f" (no earlier episodes of {unknown} of {cases_in_total})"

    where = f"with {counted(workers, 'worker')}" if workers else "in one process, without Ray"
    out.print(f"estimated time {where}: {time}{without_episodes}")


def _forecast_table(forecast: Sequence[Forecast]) -> Table:
    """Return a table with a row for each case."""
    rows = Table(box=SIMPLE_HEAD, padding=0, pad_edge=False)
    for title in ("policy", "env"):
        rows.add_column(title, overflow="fold")
    for title in ("seeds", "episodes", "finished", "remaining", "s each", "time"):
        rows.add_column(title, justify="right", no_wrap=True)

    for row in forecast:
        episode_seconds = "?"
        time = "?"
        if row.seconds is not None:
            episode_seconds = f"{row.seconds:.3g}"
            time = _time(row.remaining * row.seconds)
        rows.add_row(
            row.case.policy_id,
            " ".join(filter(None, row.case.name[1:])),
            str(len(row.case.suite.seeds)),
            str(row.case.planned),
            str(row.finished),
            str(row.remaining),
            episode_seconds,
            time,
        )
    return rows


def forecasts(planned: Sequence[EvalCase], results: Results | None) -> list[Forecast]:
    """Return the forecast of each case.

    Args:
        planned: The cases.
        results: The earlier results in the same folder; None if there are none.

    Returns:
        The forecasts, in the order of the cases.
    """
    recorded_cases = [] if results is None else results.cases
    names = [(recorded.policy_id, recorded.suite, recorded.env) for recorded in recorded_cases]
    forecast = []
    for case in planned:
        finished = 0
        has_stopped = False
        if case.name in names:
            recorded_case = recorded_cases[names.index(case.name)]
            finished = _finished(case, [episode.result for episode in recorded_case.episodes])
            has_stopped = recorded_case.stopped_at is not None

        seconds: list[float] = []
        for recorded in recorded_cases:
            if (recorded.policy, recorded.env) == (case.policy.name, case.env):
                seconds += [episode.seconds for episode in recorded.counted]

        remaining = 0 if has_stopped else case.planned - finished
        mean_s = sum(seconds) / len(seconds) if seconds else None
        forecast.append(Forecast(case, finished, remaining, mean_s))
    return forecast


def _finished(case: EvalCase, results: Sequence[EpisodeResult]) -> int:
    """Return the number of planned episodes of a case that already have a result."""
    first_seeds = set(case.suite.seeds)
    finished: set[tuple[int, int]] = set()
    for result in results:
        if result.status == "infra_failed":
            continue
        episode, seed = result.key.episode, result.key.seed
        if episode < case.suite.episodes and seed - episode in first_seeds:
            finished.add((episode, seed))
    return len(finished)


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """Return a number with its noun, such as "1 case" or "2 cases".

    Args:
        number: The number.
        noun: The noun in the singular.
        plural: The noun in the plural; default: with an "s".
    """
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def _time(seconds: float) -> str:
    """Return a duration as H:MM:SS."""
    return str(datetime.timedelta(seconds=round(seconds)))
