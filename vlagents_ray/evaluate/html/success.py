"""How often the tasks were solved: the table, over checkpoints, and over the steps of an episode."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from vlagents_ray.evaluate.html.charts import Series, interval_glyph, rate_chart
from vlagents_ray.evaluate.html.elements import Child, Html, Section, fold, row, section, table, tag
from vlagents_ray.evaluate.html.numbers import interval, number, percent
from vlagents_ray.evaluate.results import CellResults
from vlagents_ray.evaluate.statistics import Rate, success_curve
from vlagents_ray.evaluate.summary import TOTAL, Group, Summary, group_of

MOST_CURVES = 6  # that a chart holds and a reader tells apart


def success(summary: Summary) -> Section:
    """The table: each task, each suite where there are several, and all."""
    several = len(summary.results.contenders) > 1
    head = ["Task", *(["Policy"] if several else []), "Episodes", "Solved once, %", "95 % interval", ""]
    head += ["Solved at end, %", "95 % interval", "Steps", "Return"]
    bodies = [_body(env, groups, several, "sum" if whole else None) for env, groups, whole in _blocks(summary)]
    return section(
        "Success",
        table(head, bodies, "Success by task", words=2 if several else 1),
        tag(
            "p",
            "Solved once: after some step; at end: after the last one. "
            f"Intervals are of the true rate{_method(summary)}. Errors of the policy count as not solved; "
            "what infrastructure kept from ending is in no rate. Steps and return are means.",
            class_="note",
        ),
        _stopping(summary),
    )


def learning_curve(summary: Summary) -> Section | None:
    """Success over the training steps of each policy that has several; None if none has."""
    charts = [_learning_chart(summary, None)]
    suites = list(dict.fromkeys(cell.suite for cell in summary.results.cells))
    if len(suites) > 1:
        charts += [_learning_chart(summary, suite) for suite in suites]
    drawn = [chart for chart in charts if chart is not None]
    return section("Learning curve", tag("div", drawn, class_="panels")) if drawn else None


def success_over_time(summary: Summary) -> Section | None:
    """The share of episodes that are solved by each step; None if nothing was played."""
    groups = [group for group in summary.totals if group.episodes]
    shown = sorted(groups, key=lambda group: -(group.success_once.rate or 0.0))[:MOST_CURVES]
    if not shown:
        return None
    order = [group.contender for group in groups if group in shown]
    played = {name: [one for cell in summary.results.of(name) for one in cell.counted] for name in order}
    horizon = max(1, *(one.steps for results in played.values() for one in results))
    curves = []
    for index, name in enumerate(order):
        curve = success_curve([one.first_success for one in played[name]], horizon)
        curves.append(Series(name, index, list(zip(curve.steps, curve.solved, strict=True)), stepped=True))
    left_out = len(groups) - len(shown)
    text = "Bands are Wilson's interval at each step by itself. An episode that ended unsolved stays unsolved."
    if left_out:
        text += f" The {MOST_CURVES} that solved most are shown, {left_out} are not."
    chart = rate_chart(curves, "env steps", "Episodes solved by each step")
    rows = [
        row(one.name, *(percent(_by(one, share)) for share in (0.25, 0.5, 0.75, 1.0)), number(one.points[-1][0], 0))
        for one in curves
    ]
    numbers = table(["Solved, %, by", "¼ of the steps", "½", "¾", "the last", "steps"], rows, "Success over time")
    return section("Success over time", chart, tag("p", text, class_="note"), fold("As numbers", numbers, printed=True))


def _method(summary: Summary) -> str:
    """Of the table's intervals, unless `_stopping` says it."""
    return ", by Wilson's method" if summary.total.success_once.bounds is None else ""


def _stopping(summary: Summary) -> Html | None:
    """What early stopping means for the numbers of the page."""
    if summary.total.success_once.bounds is None:
        return None
    return tag(
        "p",
        f"Cells could stop early, by the rule in the settings; {summary.total.stopped} did. So the intervals of this "
        "table are confidence sequences, which hold whenever one stops. Tests, differences and bands over time do not "
        "allow for that.",
        class_="note",
    )


def _blocks(summary: Summary) -> Iterator[tuple[str, list[Group], bool]]:
    """Name, groups, and is it a sum: of tasks in the order of the plan, of each suite after its tasks, and of all."""
    cells: dict[str, dict[str, list[Group]]] = {}
    for group in summary.cells:
        cells.setdefault(group.suite, {}).setdefault(group.env, []).append(group)
    for suite, envs in cells.items():
        for env, groups in envs.items():
            yield " ".join(filter(None, (suite, env))), groups, False
        if len(cells) > 1 and len(envs) > 1:
            yield f"all of {suite or 'the nameless suite'}", _of_suite(summary, suite), True
    if len(summary.cells) > len(summary.totals):
        yield "all", list(summary.totals), True


def _of_suite(summary: Summary, suite: str) -> list[Group]:
    by_contender: dict[str, list[CellResults]] = {}
    for cell in summary.results.cells:
        if cell.suite == suite:
            by_contender.setdefault(cell.contender, []).append(cell)
    return [group_of((name, suite, TOTAL), found) for name, found in by_contender.items()]


def _body(env: str, groups: Sequence[Group], several: bool, class_: str | None) -> Html:
    rows = []
    for index, group in enumerate(groups):
        heading = tag("th", env, scope="rowgroup", rowspan=len(groups)) if index == 0 else None
        names = [tag("th", group.contender, scope="row")] if several else []
        rows.append(tag("tr", heading, names, [tag("td", cell, class_="n") for cell in _cells(group)]))
    return tag("tbody", rows, class_=class_)


def _cells(group: Group) -> list[Child]:
    played = str(group.episodes) if group.episodes == group.planned else f"{group.episodes}/{group.planned}"
    once, end = group.success_once, group.success_at_end
    return [
        played, tag("strong", percent(once)), interval(once), interval_glyph(once), percent(end), interval(end),
        number(group.mean_steps), number(group.mean_return, 2),
    ]  # fmt: skip


def _learning_chart(summary: Summary, suite: str | None) -> Html | None:
    """Of one suite, or of all; a line for each policy with several steps."""
    by_policy: dict[str, dict[int, list[CellResults]]] = {}
    for cell in summary.results.cells:
        if cell.step is not None and suite in (None, cell.suite):
            by_policy.setdefault(cell.policy, {}).setdefault(cell.step, []).append(cell)
    lines = []
    for index, (policy, steps) in enumerate(by_policy.items()):
        points = [(step, group_of((policy, "", TOTAL), found).success_once) for step, found in sorted(steps.items())]
        if len(points) > 1:
            lines.append(Series(policy, index, points))
    title = "Success over training" if suite is None else suite or "the nameless suite"
    return rate_chart(lines, "training step", title) if lines else None


def _by(curve: Series, share: float) -> Rate:
    """What is solved by that share of the longest episode's steps."""
    until = share * curve.points[-1][0]
    return next(rate for step, rate in reversed(curve.points) if step <= until)
