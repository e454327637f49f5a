"""`report.html`: an evaluation as one self-contained page.

This module, `success` and `episodes` compute the content, and `charts` the geometry of the charts.
`templates/page.html.j2` is the template of the page. `sections.html.j2` has a macro for each
section, and `elements.html.j2` and `charts.html.j2` contain the elements that sections share. The
contents of `report.css` and `report.js` are embedded in the page.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from vlagents_ray.chunking.timeliness import TimeShare
from vlagents_ray.evaluate.artifacts.storage import storing, whole
from vlagents_ray.evaluate.episode.records import EpisodeResult
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
    Difference,
    compare_all,
    learning_curves,
    success_table,
    totals,
)
from vlagents_ray.evaluate.results.changes import Change
from vlagents_ray.evaluate.results.comparison import clock_gaps
from vlagents_ray.evaluate.results.modes import modes
from vlagents_ray.evaluate.results.reader import CaseResults, Results, Run, by_timing, rate_of
from vlagents_ray.evaluate.results.statistics import median
from vlagents_ray.evaluate.results.summary import Summary, pushed_of, reported, summarize

FILE = "report.html"
STAGES = {  # Stages in `act.info["timing"]`, in order -> their names on the page.
    "decode_ms": "decode",
    "queue_ms": "queue",
    "inference_ms": "inference",
    "encode_ms": "encode",
    "wire_ms": "wire",
}
MOST_BARS = 12


class Figure(NamedTuple):
    """A number in the header of the page."""

    value: str
    name: str
    note: str


class Section(NamedTuple):
    """A part of the page with a heading in the table of contents."""

    title: str
    macro: str  # the name of a macro of sections.html.j2
    view: Any  # the argument of the macro; without it, or if it is empty, the section is left out

    @property
    def anchor(self) -> str:
        """The id of the section's heading."""
        return self.title.lower().replace(" ", "-")


def write_report(
    results: Results, path: Path, *, inline: bool = False, accept_changes: bool = False
) -> Path:
    """Write the report of one folder, or of several (`combined`), to an HTML file. If the file
    cannot be written completely, no file is written.

    Args:
        results: The results.
        path: The file. Missing folders are made.
        inline: Whether the page embeds videos, up to `episodes.BUDGET` bytes. It links to all other
            videos, relative to `path`.
        accept_changes: Compare policies even if files, settings or weights changed between them
            (see `compare`); the page shows these changes.

    Returns:
        `path`.
    """
    gallery = Gallery(results, path, inline=inline)
    text = report(summarize(results), gallery, accept_changes=accept_changes)
    with storing(path.parent), whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def report(summary: Summary, gallery: Gallery, *, accept_changes: bool = False) -> str:
    """Return the page as HTML."""
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

    template = _templates().get_template("page.html.j2")
    return template.render(
        summary=summary,
        policies=list(dict.fromkeys(case.policy for case in results.cases)),
        tasks=len({(case.suite, case.env) for case in results.cases}),
        run=results.runs[-1],
        figures=figures,
        sections=[section for section in sections if section.view],
    )


def _answer(summary: Summary, compared: Comparisons | None) -> Figure | None:
    """Return the headline of a comparison of two policy ids, which is the difference of their
    rates; None for any other report.

    The headline is not the rate of the better policy, which would be biased upwards because the
    policy is selected by its rate. Cases that stopped after different numbers of episodes have no
    headline, since they have no common rate.
    """
    if compared is None or not summary.has_one_rate_each:
        return None
    differences: list[Difference] = []
    for part in compared.parts:
        differences += part.shown + part.folded
    if len(differences) != 1:
        return None

    [difference] = differences
    verdict = "" if difference.decided else ", not significant"
    low, high = (charts.points(bound) for bound in difference.interval)
    return Figure(
        f"{charts.points(difference.pairs.difference)} points",
        f"{difference.a} less {difference.b}{verdict}",
        f"95 % [{low}, {high}], p {charts.p_value(difference.adjusted)}",
    )


def _solved(summary: Summary) -> Figure:
    """Return the headline without a comparison.

    The headline is a success rate if the cases have a common rate, otherwise the range of their
    rates. If there are synchronous episodes, only these count.
    """
    best = summary.best[0]
    timing, group = next(iter(summary.parts(best).items()))
    name = "solved" if len(summary.results.policy_ids) == 1 else f"solved by the best, {best}"
    if len(by_timing(summary.results.cases)) > 1:
        name += f", {timing}"

    once = group.success_once
    if once.pooled:
        note = f"{charts.interval_name(once)} {interval(once)} %"
        return Figure(f"{percent(once)} %", name, note)

    cases = by_timing(summary.results.of(best))[timing]
    rates = [rate_of([case], "success_once") for case in cases]
    known_rates = sorted(
        (rate for rate in rates if rate.rate is not None), key=lambda rate: rate.rate or 0.0
    )
    note = (
        f"{quantity(len(cases), 'task')} that stopped after different numbers of episodes: no "
        "common rate"
    )
    return Figure(f"{percent(known_rates[0])} to {percent(known_rates[-1])} %", name, note)


@cache
def _templates() -> Environment:
    # Names and errors may contain any text, so every value in a template is escaped.
    loader = PackageLoader(__package__ or "")
    env = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    env.filters.update(
        bounds=charts.bounds,
        difference_limit=charts.difference_limit,
        duration=charts.duration,
        interval=charts.interval,
        interval_glyph=charts.interval_glyph,
        interval_name=charts.interval_name,
        json=_json,
        moment=charts.moment,
        number=charts.number,
        p_value=charts.p_value,
        percent=charts.percent,
        points=charts.points,
        px=charts.px,
        quantity=charts.quantity,
    )
    env.globals.update(
        AT_ONCE=AT_ONCE,
        MINUS=charts.MINUS,
        NONE=charts.NONE,
        PLOT=charts.PLOT,
        difference_glyph=charts.difference_glyph,
        difference_labels=charts.difference_labels,
    )

    # These two files are not escaped, since they are part of the package and contain no text from
    # elsewhere.
    folder = files(__package__ or "")
    for suffix in ("css", "js"):
        text = (folder / f"report.{suffix}").read_text("utf-8")
        env.globals[suffix] = Markup(text.strip())  # noqa: S704
    return env


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


@dataclass(frozen=True, slots=True)
class Latency:
    """The durations of the stages of an answer for each policy, and of the env. Each duration is
    the median of the episodes' medians.
    """

    chart: BarChart | None  # the chart; None: no server reported the stages
    stages: list[str]  # the stages that at least one policy reported
    # (policy id, durations in ms, duration of the env's reset in ms, number of answers); the
    # durations belong to the stages, to an answer (median and 95th percentile) and to a step of the
    # env.
    rows: list[tuple[str, list[float | None], float | None, int]]
    transports: list[str]
    timed: int  # number of policy ids with stages; the chart shows the first `MOST_BARS` of them
    # (policy id, task, figures) for each case; the figures are None if the environment waits for
    # the policy
    in_time: list[tuple[str, str, TimeShare | None]]
    modes: list[str]  # a line for each mode in real time or on a robot, see `modes`


def latency(summary: Summary) -> Latency | None:
    """Return the latencies; None if no episode was run."""
    counted: dict[str, list[EpisodeResult]] = {}  # keys: policy ids
    for name in summary.results.policy_ids:
        results = summary.results.only(name).counted
        if results:
            counted[name] = results
    if not counted:
        return None

    stage_ms: dict[str, dict[str, float]] = {}  # durations of the stages of each policy id
    for name, results in counted.items():
        stage_ms[name] = {}
        for key, stage in STAGES.items():
            ms = median(result.timing_ms.get(key) for result in results)
            if ms is not None:
                stage_ms[name][stage] = ms
    timed = {name: times for name, times in stage_ms.items() if times}
    reported = set().union(*timed.values())
    stages = [stage for stage in STAGES.values() if stage in reported]

    rows = []
    for name, results in counted.items():
        times = [stage_ms[name].get(stage) for stage in stages]
        times.append(median(result.policy_ms for result in results))
        times.append(median(result.policy_p95_ms for result in results))
        times.append(median(result.env_step_ms for result in results))
        reset_ms = median(result.reset_ms for result in results)
        rows.append((name, times, reset_ms, sum(result.acts for result in results)))

    bars = dict(itertools.islice(timed.items(), MOST_BARS))
    chart = charts.bar_chart(bars, "Time of one call of the policy, by stage") if bars else None
    in_time = [
        (group.policy_id, f"{group.suite} {group.env}".strip(), group.time_share)
        for group in summary.cases
    ]
    return Latency(
        chart, stages, rows, summary.transports, len(timed), in_time, modes(summary.results)
    )


_SETTINGS = ("env_options", "reset_options", "clock")


@dataclass(frozen=True, slots=True)
class Env:
    """Envs with equal descriptions and contracts."""

    tasks: list[str]
    constants: Mapping[str, Any] | None  # the constants of the benchmark's protocol
    described: Mapping[str, Any]
    settings: Mapping[str, Any]
    contract: str | None  # the contract as YAML


@dataclass(frozen=True, slots=True)
class Configuration:
    """Runs, workers, versions, the metadata of each policy's server, and all settings of the
    evaluation.
    """

    runs: tuple[Run, ...]
    changes: list[Change]  # changes of files or weights between episodes
    plan_changes: list[Change]  # changes of the plan after the first results
    # (env, versions of its software and digests of its files at the last run)
    programs: list[tuple[str, Mapping[str, str]]]
    # (policy id, checkpoint, commit, digest or version of the weights)
    checkpoints: list[tuple[str, str]]
    workers: list[tuple[str, str, str, str, int]]  # (host, policy, transport, renderer, workers)
    # (numbers of runs, their versions of packages)
    versions: list[tuple[list[int], Mapping[str, Any]]]
    policies: list[tuple[str, str]]  # (name, metadata as YAML)
    settings: list[tuple[str, str]]  # (folder, settings as YAML)


@dataclass(frozen=True, slots=True)
class Repeat:
    """The arguments of the commands that repeat the evaluation and write this page again."""

    # (settings as YAML, whether they lack a policy that Python code created)
    runs: list[tuple[str, bool]]
    folders: list[str]


def protocol(results: Results) -> list[Env]:
    """Return the descriptions and contracts of the envs, with one entry for all envs whose
    description and contract are equal.
    """
    alike: dict[str, list[CaseResults]] = {}
    for case in results.cases:
        settings = {name: case.settings.get(name) for name in _SETTINGS}
        text = json.dumps([case.described, case.contract, settings], sort_keys=True)
        alike.setdefault(text, []).append(case)

    envs = []
    for cases in alike.values():
        first = cases[0]
        tasks = list(dict.fromkeys(case.task for case in cases))
        described = dict(first.described)
        protocol = described.pop("protocol", None)
        constants = protocol if isinstance(protocol, Mapping) else None
        settings = {name: first.settings.get(name) for name in _SETTINGS}
        settings = {name: value for name, value in settings.items() if value}
        contract = _yaml(first.contract) if first.contract else None
        envs.append(Env(tasks, constants, described, settings, contract))
    return envs


def configuration(results: Results) -> Configuration:
    """Return the software and the machines that produced the results."""
    programs: dict[str, Mapping[str, str]] = {}  # keys: envs
    checkpoints: dict[tuple[str, str], None] = {}
    for case in results.cases:
        if case.program:
            programs[case.env] = case.program
        commit = reported(case, "revision")
        identities = (
            reported(case, "checkpoint"),
            None if commit is None else f"commit {commit}",
            reported(case, "weights"),
            pushed_of(case),
        )
        for identity in identities:
            if identity is not None:
                checkpoints[case.policy_id, identity] = None

    processes: dict[tuple[str, str, str, str], set[tuple[int, int]]] = {}  # (run, pid)
    for worker in results.workers:
        description = (worker.host, worker.policy, worker.transport, worker.renderer or "none")
        processes.setdefault(description, set()).add((worker.run, worker.pid))

    last_runs = _last_runs(results)
    versions: list[tuple[list[int], Mapping[str, Any]]] = []
    for numbers, of_runs in results.versions:
        versions.append(
            (numbers, {name: value for name, value in of_runs.items() if value is not None})
        )

    return Configuration(
        runs=results.runs,
        changes=[change for change in results.accepted_changes if not change.is_of_plan],
        plan_changes=[change for change in results.accepted_changes if change.is_of_plan],
        programs=list(programs.items()),
        checkpoints=list(checkpoints),
        workers=[
            (*description, len(members)) for description, members in sorted(processes.items())
        ],
        versions=versions,
        policies=[(name, _yaml(metadata)) for name, metadata in results.policies.items()],
        settings=[(str(run.config.get("out")), _yaml(run.config)) for run in last_runs],
    )


def repeat(results: Results) -> Repeat:
    """Return the settings and the folders of the commands that repeat the evaluation.

    The settings do not contain the addresses of policies that were served only for the run.
    """
    folders = list(dict.fromkeys(str(run.config.get("out")) for run in results.runs))
    runs = []
    for run in _last_runs(results):
        config = EvalConfig.model_validate(run.config)
        document = config.model_dump(
            mode="json", exclude_defaults=True, exclude={"out", "resume", "accept_changes"}
        )
        lacks_a_policy = False
        for policy in document["policies"]:
            if policy.get("source") is not None:
                policy.pop("url", None)
            elif policy.get("url") is None:
                lacks_a_policy = True
        runs.append((_yaml(document), lacks_a_policy))
    return Repeat(runs, folders)


def _last_runs(results: Results) -> list[Run]:
    """Return the last run of each folder. Earlier runs had the same settings, except for settings
    that do not affect the results.
    """
    return list({run.config.get("out"): run for run in results.runs}.values())


def _yaml(value: Any) -> str:
    return str(yaml.safe_dump(value, sort_keys=False, allow_unicode=True, width=100)).rstrip()
