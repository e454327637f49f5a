"""Where the numbers come from: protocol, contracts, settings, versions; and how to cite and repeat them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import yaml

from vlagents_ray.evaluate.config import EvalConfig
from vlagents_ray.evaluate.html.elements import Child, Html, Section, block, fold, row, section, table, tag, terms
from vlagents_ray.evaluate.html.numbers import duration, interval, interval_name, moment, percent
from vlagents_ray.evaluate.results import CellResults, Results, Run
from vlagents_ray.evaluate.summary import Group, Summary, checkpoint_of

PROTOCOL = "protocol"  # of what an env describes: the constants of its benchmark


def protocol(results: Results) -> Section:
    """What the envs said of themselves, and their contracts; envs that said the same are one entry."""
    said: dict[str, tuple[CellResults, list[str]]] = {}
    for cell in results.cells:
        settings = {name: cell.settings.get(name) for name in ("env_options", "reset_options", "clock")}
        same = json.dumps([cell.described, cell.contract, settings], sort_keys=True)
        said.setdefault(same, (cell, []))[1].append(cell.env)
    return section("Protocol", [_env(cell, list(dict.fromkeys(names))) for cell, names in said.values()])


def configuration(results: Results) -> Section:
    """Runs, workers, versions, what each policy's server said of itself, and all settings."""
    runs = [
        row(
            str(run.run), moment(run.started), "killed" if run.ended is None else duration(run.ended - run.started),
            run.state, str(run.config.get("out", "")), words=5,
        )
        for run in results.runs
    ]  # fmt: skip
    checkpoints = {cell.contender: checkpoint_of(cell) for cell in results.cells}
    named = [(name, tag("code", found)) for name, found in checkpoints.items() if found is not None]
    return section(
        "Configuration",
        table(["Run", "Started", "Took", "State", "Folder"], runs, "Runs", words=5),
        [tag("h3", "Checkpoints"), terms(named)] if named else None,
        _workers(results),
        tag("h3", "Versions"),
        [_versions(run) for run in _last_runs(results)],
        [
            fold(f"Policy {name}, as its server describes it", block(_yaml(said)))
            for name, said in results.policies.items()
        ],
        [
            fold(f"All settings of {run.config.get('out')}", block(_yaml(run.config)), printed=True)
            for run in _last_runs(results)
        ],
    )


def repeat(summary: Summary) -> Section:
    """Sentences for a paper, and the commands that give the same again."""
    results = summary.results
    return section(
        "To cite and to repeat",
        tag("h3", "In words"),
        [tag("p", _sentence(group, results)) for group in summary.totals if group.episodes],
        tag("h3", "The same again"),
        [_again(run) for run in _last_runs(results)],
        tag("p", "This page from the same results:"),
        block(f"vlagents-ray report {' '.join(dict.fromkeys(str(run.config.get('out')) for run in results.runs))}"),
    )


def _env(cell: CellResults, names: list[str]) -> Html:
    described = dict(cell.described)
    constants = described.pop(PROTOCOL, None)
    title = ", ".join(names) if len(names) <= 3 else f"{names[0]} and {len(names) - 1} more"
    settings = {name: value for name in ("env_options", "reset_options", "clock") if (value := cell.settings.get(name))}
    return tag(
        "div",
        tag("h3", title),
        fold("All of them", tag("p", ", ".join(names)), printed=True) if len(names) > 3 else None,
        _facts(constants) if isinstance(constants, Mapping) else None,
        _facts(described) if described else tag("p", "No worker has made it, so it has not described itself."),
        [tag("h4", "Options"), _facts(settings)] if settings else None,
        fold("Contract: what it gives and takes", block(_yaml(cell.contract))) if cell.contract else None,
        class_="env",
    )


def _facts(values: Mapping[str, Any]) -> Html:
    return terms((name.replace("_", " "), _value(value)) for name, value in values.items())


def _value(value: Any) -> Child:
    if isinstance(value, Mapping):
        return _facts(value)
    return tag("code", value if isinstance(value, str) else json.dumps(value, ensure_ascii=False))


def _workers(results: Results) -> list[Html] | None:
    """Where the workers ran, by host, policy, transport and renderer; None of results that do not say."""
    if not results.workers:
        return None
    alike: dict[tuple[str, ...], set[tuple[int, int]]] = {}
    for one in results.workers:
        alike.setdefault((one.host, one.policy, one.transport, one.renderer or "none"), set()).add((one.run, one.pid))
    head = ["Host", "Policy", "Transport", "Renderer", "Workers"]
    rows = [row(*where, str(len(workers)), words=4) for where, workers in sorted(alike.items())]
    return [tag("h3", "Workers"), table(head, rows, "Where the workers ran", words=4)]


def _last_runs(results: Results) -> list[Run]:
    """Of each folder the last one: those before had the same settings, as far as results depend on them."""
    return list({run.config.get("out"): run for run in results.runs}.values())


def _versions(run: Run) -> Html:
    return terms((name.replace("_", " "), _value(value)) for name, value in run.versions.items() if value is not None)


def _sentence(group: Group, results: Results) -> str:
    cells = results.of(group.contender)
    envs = list(dict.fromkeys(cell.env for cell in cells))
    what = f"{', '.join(envs)}" if len(envs) <= 3 else f"{len(envs)} tasks"
    version = next((run.versions.get("vlagents-ray") for run in reversed(results.runs)), None)
    once, end = group.success_once, group.success_at_end
    return (
        f"{group.contender} solved {percent(once)} % of {once.episodes} episodes of {what} at some step "
        f"({interval_name(once)} {interval(once)} %), and {percent(end)} % at the last one ({interval(end)} %); "
        f"evaluated with vlagents-ray {version}, {_seeds(cells)}."
    )


def _seeds(cells: list[CellResults]) -> str:
    seeds = sorted({one.result.key.seed for cell in cells for one in cell.episodes if one.counts})
    if seeds[-1] - seeds[0] + 1 == len(seeds):
        return f"seeds {seeds[0]} to {seeds[-1]}"
    return f"{len(seeds)} seeds from {seeds[0]} to {seeds[-1]}"


def _again(run: Run) -> Iterator[Html]:
    """The settings as a file of runs. What was served for the run is served again, so its address is left out."""
    config = EvalConfig.model_validate(run.config)
    document = config.model_dump(mode="json", exclude_defaults=True, exclude={"out", "resume"})
    for policy in document["policies"]:
        if policy.get("source") is not None:
            policy.pop("url", None)
    if any(not {"source", "url"} & policy.keys() for policy in document["policies"]):
        yield tag("p", "A policy of this run was made in Python, by an agent_factory: the file does not name it.")
    yield tag("p", "Save this as again.yaml:")
    yield block(_yaml(document))
    yield block("vlagents-ray eval again.yaml --out runs/again")


def _yaml(value: Any) -> str:
    return str(yaml.safe_dump(value, sort_keys=False, allow_unicode=True, width=100)).rstrip()
