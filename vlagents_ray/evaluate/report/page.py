"""`report.html`: an evaluation as one self-contained page.

Python computes the content: this module, `success` and `episodes`, with the geometry of `charts`.
`templates/page.html.j2` is the page, `sections.html.j2` has a macro for each of its sections,
`elements.html.j2` and `charts.html.j2` have their common parts. `report.css` and `report.js` are
written into the page.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from vlagents_ray.evaluate.artifacts.storage import storing, whole
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.report import charts
from vlagents_ray.evaluate.report.charts import (
    BarChart,
    duration,
    interval,
    number,
    percent,
    quantity,
)
from vlagents_ray.evaluate.report.episodes import AT_ONCE, Gallery, episodes, errors, failures
from vlagents_ray.evaluate.report.success import (
    Comparisons,
    compare_all,
    learning_curves,
    success_table,
    totals,
)
from vlagents_ray.evaluate.results.changes import Change
from vlagents_ray.evaluate.results.comparison import clock_gaps
from vlagents_ray.evaluate.results.reader import CaseResults, Results, Run, by_timing, rate_of
from vlagents_ray.evaluate.results.summary import Summary, median, pushed_of, stated, summarize

FILE = "report.html"
STAGES = {  # of `act.info["timing"]`, in their order
    "decode_ms": "decode",
    "queue_ms": "queue",
    "inference_ms": "inference",
    "encode_ms": "encode",
    "wire_ms": "wire",
}
MOST_BARS = 12


class Figure(NamedTuple):
    """A number of the page's head."""

    value: str
    name: str
    note: str


class Section(NamedTuple):
    """A part of the page with a heading in the table of contents."""

    title: str
    macro: str  # of sections.html.j2
    view: Any  # its argument; None or empty: the page has no such section

    @property
    def anchor(self) -> str:
        """The id of its heading."""
        return self.title.lower().replace(" ", "-")


def write_report(
    results: Results, path: Path, *, inline: bool = False, accept_changes: bool = False
) -> Path:
    """Write the report of one folder, or of several (`combined`), to the HTML file `path`, whole or
    not at all.

    With `inline`, videos are in the page, up to `episodes.BUDGET` bytes; others are links, relative
    to `path`. Missing folders are made. With `accept_changes`, policies are compared although
    something changed between them (`compare`), and the page shows these changes. Returns `path`.
    """
    text = report(
        summarize(results), Gallery(results, path, inline=inline), accept_changes=accept_changes
    )
    with storing(path.parent), whole(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def report(summary: Summary, gallery: Gallery, *, accept_changes: bool = False) -> str:
    results, total = summary.results, summary.total
    compared = compare_all(summary, accept_changes=accept_changes)
    figures = [
        _answer(summary, compared) or _solved(summary),
        Figure(number(total.episodes, 0), "episodes", f"of {number(total.planned, 0)} planned"),
        Figure(number(total.steps, 0), "env steps", f"{number(summary.steps_per_second)} a second"),
        Figure(
            duration(summary.wall_seconds),
            "wall time",
            f"{quantity(total.retries, 'attempt')} repeated",
        ),
    ]
    sections = [
        Section("Success", "success", success_table(summary)),
        Section("Comparison", "comparison", compared),
        Section("Gap to the synchronous score", "real_time", totals(clock_gaps(results))),
        Section("Learning curve", "learning_curve", learning_curves(summary)),
        Section("Latency", "latency", latency(summary)),
        Section("Failures", "failures", failures(results, gallery)),
        Section("Episodes", "episodes", episodes(results, gallery)),
        Section("Errors", "errors", errors(results)),
        Section("Protocol", "protocol", protocol(results)),
        Section("Configuration", "configuration", configuration(results)),
        Section("To repeat", "repeat", repeat(results)),
    ]
    return (
        _templates()
        .get_template("page.html.j2")
        .render(
            summary=summary,
            policies=list(dict.fromkeys(case.policy for case in results.cases)),
            tasks=len({(case.suite, case.env) for case in results.cases}),
            run=results.runs[-1],
            figures=figures,
            sections=[one for one in sections if one.view],
        )
    )


def _answer(summary: Summary, compared: Comparisons | None) -> Figure | None:
    """Return the headline of a comparison of two policy ids, which is their difference; None for
    any other report.

    The rate of the better one would be too high, as it is chosen by its rate. Differences do not
    allow for cases that may stop early.
    """
    may_stop = any(group.success_once.error_rate is not None for group in summary.cases)
    differences = (
        []
        if compared is None
        else [row for part in compared.parts for row in (*part.shown, *part.folded)]
    )
    if may_stop or len(differences) != 1:
        return None
    [difference] = differences
    verdict = "" if difference.decided else ", not told apart"
    low, high = (charts.points(bound) for bound in difference.interval)
    return Figure(
        f"{charts.points(difference.pairs.difference)} points",
        f"{difference.a} less {difference.b}{verdict}",
        f"95 % [{low}, {high}], p {charts.p_value(difference.adjusted)}",
    )


def _solved(summary: Summary) -> Figure:
    """Return the headline without a comparison.

    It is a rate, if the cases have a common one, of synchronous episodes if there are any.
    """
    best = summary.best[0]
    timing, part = next(iter(summary.parts(best).items()))
    name = "solved" if len(summary.results.contenders) == 1 else f"solved by the best, {best}"
    if len(by_timing(summary.results.cases)) > 1:
        name += f", {timing}"
    once = part.success_once
    if once.pooled:
        return Figure(
            f"{percent(once)} %", name, f"{charts.interval_name(once)} {interval(once)} %"
        )
    cases = by_timing(summary.results.of(best))[timing]
    rates = [rate for case in cases if (rate := rate_of([case], "success_once")).rate is not None]
    low, high = (percent(pick(rates, key=lambda rate: rate.rate or 0.0)) for pick in (min, max))
    return Figure(
        f"{low} to {high} %",
        name,
        f"{quantity(len(cases), 'task')} that stopped apart: no rate in common",
    )


@cache
def _templates() -> Environment:
    # Names and errors are foreign text, so every value in a template is escaped.
    loader = PackageLoader(__package__ or "")
    env = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    formats = (
        "bounds",
        "difference_limit",
        "duration",
        "interval",
        "interval_name",
        "moment",
        "number",
        "p_value",
        "percent",
        "points",
        "quantity",
    )
    env.filters.update({name: getattr(charts, name) for name in formats})
    env.filters.update(
        interval_glyph=charts.interval_glyph,
        px=charts.px,
        json=partial(json.dumps, ensure_ascii=False),
    )
    env.globals.update(
        difference_glyph=charts.difference_glyph, difference_labels=charts.difference_labels
    )
    env.globals.update(PLOT=charts.PLOT, AT_ONCE=AT_ONCE, NONE=charts.NONE, MINUS=charts.MINUS)
    for kind in ("css", "js"):  # our own files, not templates: nothing in them is escaped
        env.globals[kind] = Markup(  # noqa: S704
            (files(__package__ or "") / f"report.{kind}").read_text("utf-8").strip()
        )
    return env


@dataclass(frozen=True, slots=True)
class Latency:
    """The stages of an answer of each policy, and the env's times: medians over the episodes'
    medians.
    """

    chart: BarChart | None  # None: no server reported its stages
    stages: list[str]  # that any policy has
    # (policy id, ms, the env's reset in ms, answers)
    rows: list[tuple[str, list[float | None], float | None, int]]
    transports: list[str]
    timed: int  # policy ids with stages; the chart shows the first `MOST_BARS`


def latency(summary: Summary) -> Latency | None:
    """Return the latencies; None if no episode was played."""
    results = summary.results
    by_name = {
        name: [one for case in results.of(name) for one in case.counted]
        for name in results.contenders
    }
    if not (played := {name: counted for name, counted in by_name.items() if counted}):
        return None
    spent: dict[str, dict[str, float]] = {}
    for name, counted in played.items():
        known = {
            stage: median(one.timing_ms.get(key) for one in counted)
            for key, stage in STAGES.items()
        }
        spent[name] = {stage: ms for stage, ms in known.items() if ms is not None}
    timed = {name: found for name, found in spent.items() if found}
    bars = dict(list(timed.items())[:MOST_BARS])
    stages = [stage for stage in STAGES.values() if any(stage in found for found in timed.values())]
    rows = [
        (
            name,
            [spent[name].get(stage) for stage in stages]
            + [
                median(getattr(one, field) for one in counted)
                for field in ("policy_ms", "policy_p95_ms", "env_step_ms")
            ],
            median(one.reset_ms for one in counted),
            sum(one.acts for one in counted),
        )
        for name, counted in played.items()
    ]
    chart = charts.bar_chart(bars, "One act of the policy, by stage") if bars else None
    return Latency(chart, stages, rows, summary.transports, len(timed))


_SETTINGS = ("env_options", "reset_options", "clock")


@dataclass(frozen=True, slots=True)
class Env:
    """Envs with equal descriptions, and their contract."""

    tasks: list[str]
    constants: Mapping[str, Any] | None  # of the benchmark
    described: Mapping[str, Any]
    settings: Mapping[str, Any]
    contract: str | None  # as YAML


@dataclass(frozen=True, slots=True)
class Configuration:
    """Runs, workers, versions, the metadata of each policy's server, and all settings."""

    runs: tuple[Run, ...]
    changes: list[Change]  # of files or weights, between episodes
    programs: list[tuple[str, Mapping[str, str]]]  # (env, digests of its files)
    # (policy id, checkpoint, commit, digest or version of its weights)
    checkpoints: list[tuple[str, str]]
    workers: list[tuple[str, str, str, str, int]]  # (host, policy, transport, renderer, workers)
    versions: list[Mapping[str, Any]]  # of each folder
    policies: list[tuple[str, str]]  # (name, metadata as YAML)
    settings: list[tuple[str, str]]  # (folder, settings as YAML)


@dataclass(frozen=True, slots=True)
class Repeat:
    """The arguments of the commands that repeat the evaluation and this page."""

    # (settings as YAML, whether they lack a policy that Python code made)
    runs: list[tuple[str, bool]]
    folders: list[str]


def protocol(results: Results) -> list[Env]:
    """Return the description and contract of the envs; envs with the same ones are one entry."""
    alike: dict[str, tuple[CaseResults, list[str]]] = {}
    for case in results.cases:
        settings = {name: case.settings.get(name) for name in _SETTINGS}
        same = json.dumps([case.described, case.contract, settings], sort_keys=True)
        alike.setdefault(same, (case, []))[1].append(case.task)
    envs = []
    for case, tasks in alike.values():
        described = dict(case.described)
        constants = described.pop("protocol", None)
        of_benchmark = constants if isinstance(constants, Mapping) else None
        settings = {name: value for name in _SETTINGS if (value := case.settings.get(name))}
        contract = _yaml(case.contract) if case.contract else None
        envs.append(Env(list(dict.fromkeys(tasks)), of_benchmark, described, settings, contract))
    return envs


def configuration(results: Results) -> Configuration:
    """Return the software and the machines that made the results."""
    named: list[tuple[str, str]] = []
    for case in results.cases:
        commit = stated(case, "revision")
        found = (
            stated(case, "checkpoint"),
            commit and f"commit {commit}",
            stated(case, "weights"),
            pushed_of(case),
        )
        named += [(case.contender, one) for one in found if one is not None]
    workers: dict[tuple[str, str, str, str], set[tuple[int, int]]] = {}
    for one in results.workers:
        where = (one.host, one.policy, one.transport, one.renderer or "none")
        workers.setdefault(where, set()).add((one.run, one.pid))
    last = _last_runs(results)
    return Configuration(
        results.runs,
        results.accepted_changes,
        list(
            {case.env: (case.env, case.program) for case in results.cases if case.program}.values()
        ),
        list(dict.fromkeys(named)),
        [(*where, len(alike)) for where, alike in sorted(workers.items())],
        [
            {name: value for name, value in run.versions.items() if value is not None}
            for run in last
        ],
        [(name, _yaml(metadata)) for name, metadata in results.policies.items()],
        [(str(run.config.get("out")), _yaml(run.config)) for run in last],
    )


def repeat(results: Results) -> Repeat:
    folders = list(dict.fromkeys(str(run.config.get("out")) for run in results.runs))
    runs = []
    for run in _last_runs(results):  # without addresses of policies that were served for the run
        config = EvalConfig.model_validate(run.config)
        document = config.model_dump(
            mode="json", exclude_defaults=True, exclude={"out", "resume", "accept_changes"}
        )
        for policy in document["policies"]:
            if policy.get("source") is not None:
                policy.pop("url", None)
        lacks_a_policy = any(
            not {"source", "url"} & policy.keys() for policy in document["policies"]
        )
        runs.append((_yaml(document), lacks_a_policy))
    return Repeat(runs, folders)


def _last_runs(results: Results) -> list[Run]:
    """Return the last run of each folder; earlier runs had the same settings, as far as results
    depend on them.
    """
    return list({run.config.get("out"): run for run in results.runs}.values())


def _yaml(value: Any) -> str:
    return str(yaml.safe_dump(value, sort_keys=False, allow_unicode=True, width=100)).rstrip()
