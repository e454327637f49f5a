"""The listings of `vlagents-ray policies` and `vlagents-ray envs`: names, state, and
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


_SHORT = 5  # maximum number of ranges of tasks that a line of the listing names


@dataclass(frozen=True)
class Listed:
    """One entry of a listing."""

    kind: str  # "policy", "wrapper" or "environment"
    name: str  # as registered
    what: str  # a description, or an environment's tasks, in one line; a key of the JSON document
    # The reason why it cannot run in this Python, with the cure; None if it is ready.
    missing: str | None
    # The settings of a policy or wrapper as `name=default`, the tasks of an environment.
    details: list[str]

    def lines(self) -> Iterator[str]:
        """Yield the full description, in whole lines, which can be copied and searched."""
        yield f"{self.name}: {self.what}"
        yield f"  {'ready' if self.missing is None else self.missing}"
        yield (
            f"  {'tasks' if self.kind == 'environment' else 'settings'}: "
            f"{', '.join(self.details) or 'none'}"
        )


def policies_and_wrappers() -> Iterator[Listed]:
    """Yield the policies, then the wrappers."""
    for kind, registered, find in (
        ("policy", "policies", policy_class),
        ("wrapper", "wrappers", wrapper_class),
    ):
        for name in sorted(names(registered)):
            try:
                cls = find(name)
            except VLAgentsError as error:
                yield Listed(kind, name, "cannot be loaded", str(error), [])
                continue
            missing = missing_packages(name) if kind == "policy" else None
            settings = list(settings_of(cls))
            yield Listed(kind, name, _what(registered, name), missing, settings)
        yield from _in_other_plugins(kind, registered)


def _what(registered: str, name: str) -> str:
    """Return the description of a registered policy or wrapper, or its module's first sentence if
    its entry has none.
    """
    entry = find_entry(registered, name)
    if entry is not None and entry.about:
        return entry.about
    return summary_of(sys.modules[target_of(registered, name).partition(":")[0]])


def environments() -> Iterator[Listed]:
    """Yield the simulators, with the ranges of their tasks."""
    for name in sorted(names("envs")):
        try:
            cls = env_class(name)
            missing = cls.missing()
            tasks = cls.tasks()
        except VLAgentsError as error:
            missing = str(error)
            tasks = []

        task_ranges = list(ranges(tasks))
        short = task_ranges
        if len(task_ranges) > _SHORT:
            short = [task_ranges[0], "…", task_ranges[-1]]
        description = "any task of the simulator"
        if tasks:
            plural = "" if len(tasks) == 1 else "s"
            description = f"{len(tasks)} task{plural}: {', '.join(short)}"
        yield Listed("environment", name, description, missing, task_ranges)
    yield from _in_other_plugins("environment", "envs")


def _in_other_plugins(kind: str, registered: str) -> Iterator[Listed]:
    """Yield the names in plug-ins of the project that are not installed."""
    for name, distribution in sorted(not_installed(registered).items()):
        cure = pip_install(distribution=distribution)
        yield Listed(kind, name, f"in {distribution}", f"not installed: {cure}", [])


def installing(listed: Sequence[Listed]) -> Iterator[str]:
    """Yield a line for each way to install missing packages: a command and the policies that need
    it, or an environment's cure.
    """
    names_by_line: dict[str, list[str]] = {}  # a line has {} for the names
    for entry in listed:
        modules: list[str] = []
        sources: list[str] = []
        requirements = ""
        if entry.kind != "environment":
            modules, sources, requirements = _lacking(entry.name)

        lines = []
        is_by_environment = bool(requirements) and bool(modules or sources)
        if is_by_environment:
            lines.append(f"vlagents-ray env make {requirements}  # {{}}")
        if sources:
            lines.append(f"export {sources[0]}=FOLDER  # a checkout, for {{}}")
        if entry.missing is not None and not is_by_environment:
            escaped = entry.missing.replace("{", "{{").replace("}", "}}")
            lines.append(f"{{}}: {escaped}")
        for line in lines:
            names_by_line.setdefault(line, []).append(entry.name)

    for line, entry_names in names_by_line.items():
        yield line.format(", ".join(entry_names))


def require_packages(config: Deployment) -> None:
    """Raise `MissingDependency` if a policy that is to run in this environment lacks packages here.

    A checkout of its source is not required, as a setting may name one.
    """
    for app in config.applications:
        if app.args.get("environment") or app.runtime_env:
            continue
        name = str(app.args.get("policy"))
        missing = missing_packages(name, checkout=False)
        if missing is not None:
            raise MissingDependency(f"policy {name!r}: {missing}")


def missing_packages(name: str, *, checkout: bool = True) -> str | None:
    """Return the packages that a model family lacks in this environment, with the cure; None if
    it lacks none.
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
        f"`vlagents-ray env make {requirements}`, and that Python in `environment` of its "
        "deployment"
    )
    if sources:
        cure += f"; {' or '.join(sources)}=FOLDER of a checkout"
        modules = [*modules, "its source"]
    return f"not in this environment ({', '.join(modules)}): {cure}"


def _lacking(name: str) -> tuple[list[str], list[str], str]:
    """Return the modules and checkout variables that a family lacks, and the name of its
    requirements, "" if it has none. A family that an extra installs is not looked at.
    """
    entry = find_entry("policies", name)
    if entry is None or entry.extra:
        return [], [], ""

    # The first of the needed modules is in the checkout, if there is one.
    has_checkout = any(os.environ.get(variable) for variable in entry.checkouts)
    needed = entry.needs[1:] if has_checkout else entry.needs
    lacking = [module for module in needed if importlib.util.find_spec(module) is None]
    lacks_source = bool(entry.checkouts) and not has_checkout and entry.needs[0] in lacking
    requirements = entry.requirements[0] if entry.requirements else ""
    if lacks_source:
        return lacking[1:], list(entry.checkouts), requirements
    return lacking, [], requirements


def settings_of(cls: type) -> Iterator[str]:
    """Return each setting as `name=default`, or its name alone if it is required."""
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
            required = parameter.default is parameter.empty
            yield parameter.name if required else f"{parameter.name}={parameter.default!r}"


def ranges(tasks: list[str]) -> Iterator[str]:
    """Join numbered names of one kind: "libero_spatial/0" to "libero_spatial/9" as
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
    """Return the name of a numbered task up to its number; None for a task without a number."""
    numbered = re.fullmatch(r"(.*/)\d+", task)
    return None if numbered is None else numbered[1]
