"""An evaluation from the command line, once its configuration is known."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from vlagents_ray.cli.console import fail, out
from vlagents_ray.cli.evaluation.policies import served
from vlagents_ray.errors import PolicyFailed
from vlagents_ray.slurm.script import UNFINISHED

POLICY_ERRORS = 3  # exit status: an error of the policy ended every episode of a cell

if TYPE_CHECKING:
    from vlagents_ray.evaluate import EvalConfig, Progress, Summary


def run_evaluation(
    config: EvalConfig,
    address: str | None = None,
    *,
    end_at: float | None = None,
    replica_per_gpu: bool = False,
    live: tuple[str, int] | None = None,
) -> None:
    """Serve the policies that are not at a URL, evaluate them all, print the table.

    `end_at` is as in `evaluate`, and `live` the address of the live page, as for `live_progress`.
    """
    with served(config, address, replica_per_gpu=replica_per_gpu) as ready, shown_progress(ready, live) as progress:
        summary = evaluate_and_print(ready, progress, end_at)
    require_results(ready, summary)


def shown_progress(
    config: EvalConfig, live: tuple[str, int] | None, *, goes_on: bool = False
) -> AbstractContextManager[Progress]:
    """Return the progress of an evaluation: on the terminal, and on the live page if that has an address."""
    from vlagents_ray.cli.evaluation.live import live_progress
    from vlagents_ray.evaluate import progress_for

    return live_progress(config.out, [one.url for one in config.policies], live, progress_for(out), goes_on=goes_on)


def play_one(config: EvalConfig, address: str | None, only: tuple[int, int]) -> Summary:
    """Serve the policy unless it is at a URL, and play one episode of it; `only` as in `evaluate`."""
    from vlagents_ray.evaluate import evaluate, progress_for

    with served(config, address) as ready:
        return evaluate(ready, progress=progress_for(out), only=only)


def evaluate_and_print(config: EvalConfig, progress: Progress, end_at: float | None = None) -> Summary:
    """Evaluate policies that are at their URLs; an interrupted evaluation prints what it has."""
    from vlagents_ray.evaluate import EvaluationInterrupted, OutOfTime, Results, evaluate, print_summary
    from vlagents_ray.evaluate.results.summary import failing_cells, summarize

    try:
        summary = evaluate(config, progress=progress, end_at=end_at)
    except PolicyFailed as error:
        results = Results.load(config.out)
        if not failing_cells(results):
            raise
        print_summary(out, summarize(results))
        fail(str(error), POLICY_ERRORS)
    except EvaluationInterrupted as interrupted:
        print_summary(out, interrupted.summary)
        if isinstance(interrupted, OutOfTime):
            fail(str(interrupted), UNFINISHED)
        raise
    print_summary(out, summary)
    return summary


def require_results(config: EvalConfig, summary: Summary) -> None:
    """End the command with status 3 if an error of the policy ended every episode of a cell that `config` plans.

    With status 1, if an episode has no result: infrastructure lost it.
    """
    from vlagents_ray.evaluate.plan.cases import cells
    from vlagents_ray.evaluate.results.summary import errors_of_policies, failing_cells

    wanted = {cell.fingerprint for cell in cells(config)}
    mine = [cell for cell in summary.results.cells if cell.cell in wanted]
    if failing := failing_cells(summary.results.among(mine)):
        (_, _, error), _ = errors_of_policies(summary.results.among(failing))[0]
        where = ", ".join(f"{cell.contender} in {cell.task}" for cell in failing)
        fail(f"every episode ended by an error of the policy: {where}; the first one: {error.strip()}", POLICY_ERRORS)
    missing = sum(cell.missing for cell in mine)
    if not missing:
        return
    lost = [attempt for cell in mine for attempt in cell.attempts if not attempt.retried]
    last = max(lost, key=lambda attempt: attempt.at, default=None)
    why = "" if last is None else f", the last one to {last.code}: {last.error.strip().partition(chr(10))[0]}"
    fail(
        f"{missing} of {sum(cell.planned for cell in mine)} episodes have no result: lost to infrastructure{why}; "
        f"the report lists every attempt under Errors, --resume tries them again",
        1,
    )
