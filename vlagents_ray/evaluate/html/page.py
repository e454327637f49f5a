"""The page: its head, what comes first, its sections, and one file of it all."""

from __future__ import annotations

import os
from importlib.resources import files
from pathlib import Path

from vlagents_ray.evaluate.html import comparing, failures, latency, origin, success
from vlagents_ray.evaluate.html.elements import Html, Section, tag
from vlagents_ray.evaluate.html.numbers import count, duration, interval, interval_name, moment, number, percent
from vlagents_ray.evaluate.html.videos import Gallery, Videos
from vlagents_ray.evaluate.results import Results
from vlagents_ray.evaluate.summary import Summary, summarize

FILE = "report.html"
# The page asks nobody for anything: a browser that knows this policy holds it to that.
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:; "
    "media-src 'self' data: file:"
)


def write_report(results: Results, path: Path, *, videos: Videos = "link") -> Path:
    """Write the report of `results` to `path`, one HTML file, whole or not at all; returns `path`.

    `videos` of episodes that failed: "link" to the files (relative to `path`), "inline" up to `videos.BUDGET` bytes and
    links for the rest, or "none", with a still of each.
    """
    text = report(summarize(results), Gallery(results.out, path, videos))
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)
    return path


def report(summary: Summary, gallery: Gallery) -> str:
    """The page as text."""
    results = summary.results
    made = [
        success.success(summary),
        comparing.comparison(summary),
        comparing.real_time(summary),
        success.learning_curve(summary),
        success.success_over_time(summary),
        latency.latency(summary),
        failures.failures(results, gallery),
        failures.errors(results),
        origin.protocol(results),
        origin.configuration(results),
        origin.repeat(summary),
    ]
    sections = [one for one in made if one is not None]
    title = f"{_names(results)}: evaluation"
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("title", title),
        tag("style", Html(_resource("style.css"))),
    )
    body = tag(
        "body", _header(summary), _contents(sections), tag("main", [one.html for one in sections]), _footer(summary),
        tag("script", Html(_resource("script.js"))),
    )  # fmt: skip
    return f"<!doctype html>\n{tag('html', head, body, lang='en')}\n"


def _header(summary: Summary) -> Html:
    results, total = summary.results, summary.total
    envs = len({(cell.suite, cell.env) for cell in results.cells})
    several = len(results.contenders) > 1
    about = f"{len(results.contenders)} policies or checkpoints, " if several else ""
    state = None if summary.state == "complete" else tag("p", f"Not complete: {summary.state}.", class_="bad")
    return tag(
        "header",
        tag("p", "Evaluation", class_="kind"),
        tag("h1", _names(results)),
        tag("p", f"{about}{count(envs, 'task')}, {moment(results.runs[-1].started)}", class_="note"),
        state,
        tag("div", _figures(summary), class_="figures"),
        tag("p", f"Lost to infrastructure, and in no rate: {count(total.infra_failures, 'episode')}.", class_="bad")
        if total.infra_failures
        else None,
    )


def _figures(summary: Summary) -> list[Html]:
    total = summary.total
    best = max(summary.totals, key=lambda group: group.success_once.rate or 0.0)
    name = "solved" if len(summary.totals) == 1 else f"solved by the best, {best.contender}"
    once = best.success_once
    return [
        _figure(f"{percent(once)} %", name, f"{interval_name(once)} {interval(once)} %"),
        _figure(number(total.episodes, 0), "episodes", f"of {number(total.planned, 0)} planned"),
        _figure(number(total.steps, 0), "env steps", f"{number(summary.steps_per_second)} a second"),
        _figure(duration(summary.wall_seconds), "wall time", f"{count(total.retries, 'attempt')} repeated"),
    ]


def _figure(value: str, name: str, beside: str) -> Html:
    return tag("div", tag("span", value, class_="value"), tag("span", name), tag("span", beside, class_="note"))


def _contents(sections: list[Section]) -> Html:
    return tag("nav", [tag("a", one.title, href=f"#{one.anchor}") for one in sections], aria_label="Sections")


def _footer(summary: Summary) -> Html:
    version = summary.results.runs[-1].versions.get("vlagents-ray")
    return tag("footer", tag("p", f"Made by vlagents-ray {version} from the results in {summary.out}."))


def _names(results: Results) -> str:
    """The policies in a few words."""
    policies = list(dict.fromkeys(cell.policy for cell in results.cells))
    return ", ".join(policies) if len(policies) <= 4 else f"{', '.join(policies[:3])} and {len(policies) - 3} more"


def _resource(name: str) -> str:
    return (files(__package__) / name).read_text(encoding="utf-8").strip()
