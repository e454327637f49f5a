"""Provenance of the numbers: protocol, contracts, settings, versions, and commands to repeat them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import yaml

from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.results.changes import Change
from vlagents_ray.evaluate.results.reader import CellResults, Results, Run
from vlagents_ray.evaluate.results.summary import pushed_of, stated

PROTOCOL = "protocol"  # key of an env's description: the constants of its benchmark
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
    checkpoints: list[tuple[str, str]]  # (policy id, checkpoint, commit, digest or version of its weights)
    workers: list[tuple[str, str, str, str, int]]  # (host, policy, transport, renderer, workers)
    versions: list[Mapping[str, Any]]  # of each folder
    policies: list[tuple[str, str]]  # (name, metadata as YAML)
    settings: list[tuple[str, str]]  # (folder, settings as YAML)


@dataclass(frozen=True, slots=True)
class Again:
    """The settings of a run as a file, without policies made by Python code."""

    yaml: str
    lacks_a_policy: bool


@dataclass(frozen=True, slots=True)
class Repeat:
    """The arguments of the commands that repeat the evaluation and this page."""

    runs: list[Again]
    folders: list[str]


def protocol(results: Results) -> list[Env]:
    """Return the description and contract of the envs; envs with the same ones are one entry."""
    alike: dict[str, tuple[CellResults, list[str]]] = {}
    for cell in results.cells:
        settings = {name: cell.settings.get(name) for name in _SETTINGS}
        same = json.dumps([cell.described, cell.contract, settings], sort_keys=True)
        alike.setdefault(same, (cell, []))[1].append(cell.task)
    return [_env(cell, list(dict.fromkeys(tasks))) for cell, tasks in alike.values()]


def configuration(results: Results) -> Configuration:
    """Return the software and the machines that made the results."""
    named = [(cell.contender, one) for cell in results.cells for one in _identity(cell)]
    workers: dict[tuple[str, str, str, str], set[tuple[int, int]]] = {}
    for one in results.workers:
        where = (one.host, one.policy, one.transport, one.renderer or "none")
        workers.setdefault(where, set()).add((one.run, one.pid))
    last = _last_runs(results)
    return Configuration(
        results.runs,
        results.accepted_changes,
        list({cell.env: (cell.env, cell.program) for cell in results.cells if cell.program}.values()),
        list(dict.fromkeys(named)),
        [(*where, len(alike)) for where, alike in sorted(workers.items())],
        [{name: value for name, value in run.versions.items() if value is not None} for run in last],
        [(name, _yaml(metadata)) for name, metadata in results.policies.items()],
        [(str(run.config.get("out")), _yaml(run.config)) for run in last],
    )


def _identity(cell: CellResults) -> list[str]:
    commit = stated(cell, "revision")
    found = (stated(cell, "checkpoint"), commit and f"commit {commit}", stated(cell, "weights"), pushed_of(cell))
    return [one for one in found if one is not None]


def repeat(results: Results) -> Repeat:
    """Return the commands that repeat the evaluation."""
    folders = list(dict.fromkeys(str(run.config.get("out")) for run in results.runs))
    return Repeat([_again(run) for run in _last_runs(results)], folders)


def _env(cell: CellResults, tasks: list[str]) -> Env:
    described = dict(cell.described)
    constants = described.pop(PROTOCOL, None)
    settings = {name: value for name in _SETTINGS if (value := cell.settings.get(name))}
    contract = _yaml(cell.contract) if cell.contract else None
    return Env(tasks, constants if isinstance(constants, Mapping) else None, described, settings, contract)


def _last_runs(results: Results) -> list[Run]:
    """Return the last run of each folder; earlier runs had the same settings, as far as results depend on them."""
    return list({run.config.get("out"): run for run in results.runs}.values())


def _again(run: Run) -> Again:
    """Return the settings as a file, without addresses of policies that were served for the run."""
    config = EvalConfig.model_validate(run.config)
    document = config.model_dump(mode="json", exclude_defaults=True, exclude={"out", "resume", "accept_changes"})
    for policy in document["policies"]:
        if policy.get("source") is not None:
            policy.pop("url", None)
    return Again(_yaml(document), any(not {"source", "url"} & policy.keys() for policy in document["policies"]))


def _yaml(value: Any) -> str:
    return str(yaml.safe_dump(value, sort_keys=False, allow_unicode=True, width=100)).rstrip()
