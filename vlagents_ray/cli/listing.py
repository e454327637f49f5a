"""The listings of `vlagents-ray policies` and `vlagents-ray envs`: names, whether they can run, and
installation commands.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

from vlagents_ray.docstrings import summary_of
from vlagents_ray.errors import MissingDependency, VLAgentsError
from vlagents_ray.registry import (
    env_class,
    find_entry,
    install_alone,
    names,
    not_installed,
    pip_install,
    policy_class,
    target_of,
    wrapper_class,
)

if TYPE_CHECKING:
    from vlagents_ray.serve.launch.deployment_file import Deployment


_SHORT = 5  # maximum number of task ranges in a line of the listing


@dataclass(frozen=True)
class Listed:
    """One entry of a listing."""

    # The names of the fields are the keys of the JSON document.
    kind: str  # "policy", "wrapper" or "environment"
    name: str  # the registered name
    what: str  # a description, or the tasks of an environment, in one line
    # The reason why the entry cannot run in this Python, with the cure; None if it can run.
    missing: str | None
    # The settings of a policy or wrapper as `name=default`, or the tasks of an environment.
    details: list[str]

    def lines(self) -> Iterator[str]:
        """Yield the full description, in lines without breaks, which can be copied and searched."""
        title = "tasks" if self.kind == "environment" else "settings"
        yield f"{self.name}: {self.what}"
        yield f"  {'ready' if self.missing is None else self.missing}"
        yield f"  {title}: {', '.join(self.details) or 'none'}"


def policies_and_wrappers() -> Iterator[Listed]:
    """Yield the entries of policies, then the entries of wrappers."""
    for noun, group, find_class in (
        ("policy", "policies", policy_class),
        ("wrapper", "wrappers", wrapper_class),
    ):
        for name in sorted(names(group)):
            try:
                cls = find_class(name)
            except VLAgentsError as error:
                yield Listed(noun, name, "cannot be loaded", str(error), [])
                continue
            missing = missing_packages(name) if noun == "policy" else None
            settings = list(settings_of(cls))
            yield Listed(noun, name, _description(group, name), missing, settings)
        yield from _in_other_plugins(noun, group)


def _description(group: str, name: str) -> str:
    """Return the description of a registered policy or wrapper. If the registry entry has no
    description, return the first sentence of the module's docstring.
    """
    entry = find_entry(group, name)
    if entry is not None and entry.about:
        return entry.about
    module_name = target_of(group, name).partition(":")[0]
    return summary_of(sys.modules[module_name])


def environments() -> Iterator[Listed]:
    """Yield the entries of simulators, with the ranges of their tasks."""
    for name in sorted(names("envs")):
        try:
            cls = env_class(name)
            missing = cls.missing()
            tasks = cls.tasks()
        except VLAgentsError as error:
            missing = str(error)
            tasks = []

        task_ranges = list(ranges(tasks))
        shown_ranges = task_ranges
        if len(task_ranges) > _SHORT:
            shown_ranges = [task_ranges[0], "…", task_ranges[-1]]
        description = "any task of the simulator"
        if tasks:
            plural = "" if len(tasks) == 1 else "s"
            description = f"{len(tasks)} task{plural}: {', '.join(shown_ranges)}"
        yield Listed("environment", name, description, missing, task_ranges)
    yield from _in_other_plugins("environment", "envs")


def _in_other_plugins(noun: str, group: str) -> Iterator[Listed]:
    """Yield the names in this project's plug-ins that are not installed."""
    for name, distribution in sorted(not_installed(group).items()):
        cure = pip_install(distribution=distribution)
        yield Listed(noun, name, f"in {distribution}", f"not installed: {cure}", [])


def installing(listed: Sequence[Listed]) -> Iterator[str]:
    """Return the commands that install missing packages.

    Args:
        listed: The entries of a listing.

    Yields:
        A line for each command, with the policies that need it, and a line for each environment,
        with its cure.
    """
    names_by_line: dict[str, list[str]] = {}  # the line, with {} in place of the names -> the names
    for entry in listed:
        modules: list[str] = []
        sources: list[str] = []
        requirements = ""
        if entry.kind != "environment":
            modules, sources, requirements = _lacking(entry.name)

        lines = []
        needs_environment = bool(requirements) and bool(modules or sources)
        if needs_environment:
            lines.append(f"vlagents-ray venv create {requirements}  # {{}}")
        if sources:
            lines.append(f"export {sources[0]}=FOLDER  # a checkout, for {{}}")
        if entry.missing is not None and not needs_environment:
            escaped = entry.missing.replace("{", "{{").replace("}", "}}")
            lines.append(f"{{}}: {escaped}")

        for line in lines:
            names_by_line.setdefault(line, []).append(entry.name)

    for line, entry_names in names_by_line.items():
        yield line.format(", ".join(entry_names))


def require_packages(config: Deployment) -> None:
    """Check that the packages of a deployment's policies are installed in this environment.

    A policy that runs in another environment is not checked. A checkout of a policy's source is not
    required, as a setting may name it.

    Raises:
        MissingDependency: A package is missing.
    """
    for app in config.applications:
        if app.args.get("environment") or app.runtime_env:
            continue
        name = str(app.args.get("policy"))
        missing = missing_packages(name, checkout=False)
        if missing is not None:
            raise MissingDependency(f"policy {name!r}: {missing}")


def missing_packages(name: str, *, checkout: bool = True) -> str | None:
    """Return a text with the packages that a model family lacks in this environment, and the
    cure.

    Args:
        name: The registered name of the policy.
        checkout: Whether a missing checkout of the source also counts as missing.

    Returns:
        The packages and the cure in words; None if nothing is missing.
    """
    entry = find_entry("policies", name)
    if entry is not None and entry.extra and not all(map(importlib.util.find_spec, entry.needs)):
        cure = pip_install(entry.extra, entry.distribution)
        return f"not in this environment ({', '.join(entry.needs)}): {cure}"

    modules, sources, requirements = _lacking(name)
    if not modules and not (sources and checkout):
        return None
    if not requirements:
        cure = "; ".join(install_alone(module) for module in modules)
        return f"not in this environment ({', '.join(modules)}): {cure}"

    cure = (
        f"`vlagents-ray venv create {requirements}`, and the Python of this environment as "
        f"`environment` in the deployment"
    )
    if sources:
        cure += f"; {' or '.join(sources)}=FOLDER of a checkout"
        modules = [*modules, "its source"]
    return f"not in this environment ({', '.join(modules)}): {cure}"


def _lacking(name: str) -> tuple[list[str], list[str], str]:
    """Return the packages that a model family lacks; empty for a family that an extra installs.

    Args:
        name: The registered name of the policy.

    Returns:
        The missing modules; the environment variables, one of which must contain the path of a
        checkout; and the name of the family's requirements file, empty if there is none.
    """
    entry = find_entry("policies", name)
    if entry is None or entry.extra:
        return [], [], ""

    # If the family needs a checkout, the checkout contains the first of the needed modules.
    has_checkout = any(os.environ.get(variable) for variable in entry.checkouts)
    needed = entry.needs[1:] if has_checkout else entry.needs
    lacking = [module for module in needed if importlib.util.find_spec(module) is None]
    lacks_source = bool(entry.checkouts) and not has_checkout and entry.needs[0] in lacking
    requirements = entry.requirements[0] if entry.requirements else ""
    if lacks_source:
        return lacking[1:], list(entry.checkouts), requirements
    return lacking, [], requirements


def settings_of(cls: type) -> Iterator[str]:
    """Yield each setting of a policy or wrapper as `name=default`, or only the name of a required
    setting.
    """
    fields: Mapping[str, Any] | None = getattr(getattr(cls, "Config", None), "model_fields", None)
    if fields is not None:
        for name, field in fields.items():
            if field.is_required():
                yield name
            else:
                yield f"{name}={field.get_default(call_default_factory=True)!r}"
        return

    for parameter in inspect.signature(cls).parameters.values():
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
            if parameter.default is parameter.empty:
                yield parameter.name
            else:
                yield f"{parameter.name}={parameter.default!r}"


def ranges(tasks: list[str]) -> Iterator[str]:
    """Join consecutive numbered tasks: "libero_spatial/0" to "libero_spatial/9" become
    "libero_spatial/0..9".
    """
    for stem, group in groupby(tasks, _stem):
        members = list(group)
        if stem is None or len(members) == 1:
            yield from members
            continue
        numbers = [int(task.removeprefix(stem)) for task in members]
        if numbers == list(range(numbers[0], numbers[-1] + 1)):
            yield f"{stem}{numbers[0]}..{numbers[-1]}"
        else:
            yield from members


def _stem(task: str) -> str | None:
    """Return the part of a task's name before its number; None for a task without a number."""
    numbered = re.fullmatch(r"(.*/)\d+", task)
    return None if numbered is None else numbered[1]
