"""The table of results at the end of an evaluation."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vlagents_ray.evaluate.report.page import FILE as REPORT
from vlagents_ray.evaluate.results.comparison import Comparison, clock_gaps
from vlagents_ray.evaluate.results.database import RUNNING
from vlagents_ray.evaluate.results.summary import Group, Summary, errors_of_policies, pushed_of


def results_table(summary: Summary) -> Table:
    """Make a table of success, length and speed: for each policy id a row for each env, and one for all together."""
    names = summary.results.contenders
    table = Table(
        title=f"{', '.join(names)}: success in %, with {_interval(summary.total)}",
        box=SIMPLE_HEAD,
        padding=0,
        pad_edge=False,
    )
    if len(names) > 1:
        table.add_column("policy", overflow="fold")
    table.add_column("env", overflow="fold")
    for title in ("episodes", "once", "at end", "steps", "policy ms", "env ms"):
        table.add_column(title, justify="right", no_wrap=True)
    for name, total in zip(names, summary.totals, strict=True):
        groups = [(group, "") for group in summary.cells if group.contender == name]
        parts = summary.parts(name)
        totals = [(total, "")] if len(parts) == 1 else [(part, timing) for timing, part in parts.items()]
        for group, timing in [*groups, *totals] if len(groups) > 1 else groups:
            table.add_row(*([name] if len(names) > 1 else []), *_cells(group, timing))
        table.add_section()
    return table


def print_summary(console: Console, summary: Summary) -> None:
    """Print the table of results, failures of infrastructure, and the paths of all files written.

    Args:
        console: The console.
        summary: The result of `evaluate`.
    """
    console.print(results_table(summary))
    if summary.total.policy_errors:
        console.print(_errors_table(summary))
    total = summary.total
    speed = summary.rollout_steps_per_second
    lines = [f"{total.steps} steps in {summary.wall_seconds:.1f} s"]
    if speed is not None:
        lines[0] += f", {speed:.1f} a second once the workers had started"
    if summary.env_busy is not None and summary.policy_busy is not None:
        lines.append(
            f"envs busy for {summary.env_busy:.0%} of the workers' time, "
            f"the policy for {summary.policy_busy:.0%} of one replica's"
        )
    if total.policy_errors:
        lines.append(f"{total.policy_errors} episodes ended by an error of the policy; they count as no success")
    if total.retries:
        lines.append(f"{total.retries} attempts lost to infrastructure and repeated")
    if total.infra_failures:
        lines.append(f"{total.infra_failures} episodes lost to infrastructure, in no rate; --resume tries them again")
    lines += [f"accepted change: {change}" for change in summary.results.accepted_changes]
    pushed = {cell.contender: words for cell in summary.results.cells if (words := pushed_of(cell)) is not None}
    lines += [f"{name}: weights pushed by a learner, {words}" for name, words in pushed.items()]
    lines += [_stopped(group) for group in summary.cells if group.stopped]
    parts = [part for name in summary.results.contenders for part in summary.parts(name).values()]
    if not all(part.success_once.pooled for part in parts):
        lines.append("cells that stopped after different numbers of episodes have no rate in common: quote each alone")
    lines += [_gap(one) for one in clock_gaps(summary.results)]
    if summary.state == RUNNING:
        lines.append("still running")
    elif summary.state != "complete":
        lines.append(f"{summary.state}: go on with --resume")
    lines.append(f"results: {summary.out}")
    if (summary.out / REPORT).is_file():
        lines.append(f"report: {summary.out / REPORT}")
    if (summary.out / "videos").is_dir():
        lines.append(f"videos: {summary.out / 'videos'}")
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _errors_table(summary: Summary) -> Table:
    table = Table(title="Errors of policies", box=SIMPLE_HEAD, padding=0, pad_edge=False)
    for title in ("policy", "env", "error"):
        table.add_column(title, overflow="fold")
    table.add_column("episodes", justify="right", no_wrap=True)
    for (policy, task, error), number in errors_of_policies(summary.results):
        table.add_row(policy, task, Text(error.strip().partition("\n")[0]), str(number))
    return table


def _interval(total: Group) -> str:
    error_rate = total.success_once.error_rate
    if error_rate is None:
        return "the Wilson 95 % interval"
    return f"the confidence sequence of early stopping (error rate {error_rate:.2g})"


def _stopped(group: Group) -> str:
    name = " ".join(filter(None, (group.contender, group.suite, group.env)))
    error_rate = group.success_once.error_rate
    return f"{name}: stopped after {group.episodes} of {group.planned} (error rate {100 * (error_rate or 0):.2g} %)"


def _gap(gap: Comparison) -> str:
    """Return the gap to the synchronous score, as in the report: on the episodes of both clocks."""
    played = [one for cell in gap.cells for one in cell.counted]
    steps = max(1, sum(one.steps for one in played))  # 0 if the policy failed before the first step of each
    waited, held = (sum(getattr(one, what) for one in played) for what in ("ticks_waited", "ticks_held"))
    low, high = gap.total.interval
    return (
        f"{gap.a}: {100 * (gap.total.pairs.difference or 0):+.1f} points to the synchronous score "
        f"({100 * low:+.1f} to {100 * high:+.1f}, {gap.total.pairs.total} pairs); "
        f"{waited / steps:.0%} of its ticks waited for an answer, {held / steps:.0%} with nothing to execute"
    )


def _cells(group: Group, timing: str) -> list[str]:
    return [
        " ".join(filter(None, (group.suite, group.env, timing))),
        f"{group.episodes}/{group.planned}",
        str(group.success_once),
        "-" if group.success_at_end.rate is None else f"{group.success_at_end.rate:.0%}",
        _number(group.mean_steps),
        _number(group.policy_ms, 2),
        _number(group.env_step_ms, 2),
    ]


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
