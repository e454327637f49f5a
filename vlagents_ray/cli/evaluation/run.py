"""An evaluation from the command line, once its configuration is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlagents_ray.cli.console import fail, out
from vlagents_ray.cli.evaluation.policies import served
from vlagents_ray.slurm.script import UNFINISHED

if TYPE_CHECKING:
    from vlagents_ray.evaluate import EvalConfig, Summary


def run_evaluation(
    config: EvalConfig, address: str | None = None, *, end_at: float | None = None, replica_per_gpu: bool = False
) -> None:
    """Serve the policies that are not at a URL, evaluate them all, print the table; `end_at` as in `evaluate`."""
    with served(config, address, replica_per_gpu=replica_per_gpu) as ready:
        summary = evaluate_and_print(ready, end_at)
    require_results(ready, summary)


def play_one(config: EvalConfig, address: str | None, only: tuple[int, int]) -> Summary:
    """Serve the policy unless it is at a URL, and play one episode of it; `only` as in `evaluate`."""
    from vlagents_ray.evaluate import evaluate, progress_for

    with served(config, address) as ready:
        return evaluate(ready, progress=progress_for(out), only=only)


def evaluate_and_print(config: EvalConfig, end_at: float | None = None) -> Summary:
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
    return summary


def require_results(config: EvalConfig, summary: Summary) -> None:
    """End the command with status 1 if an episode that `config` plans has no result: infrastructure lost it."""
    from vlagents_ray.evaluate.plan.cases import cells

    wanted = {cell.fingerprint for cell in cells(config)}
    mine = [cell for cell in summary.results.cells if cell.cell in wanted]
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
