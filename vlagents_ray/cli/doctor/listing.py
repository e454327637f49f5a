"""What `vlagents-ray policies` and `vlagents-ray envs` list: whole lines, which can be copied and searched."""

from __future__ import annotations

import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Iterator, Mapping
from itertools import groupby
from types import ModuleType
from typing import TYPE_CHECKING, Any

from vlagents_ray.errors import MissingDependency, VLAgentsError
from vlagents_ray.registry import env_class, names, policy_class, wrapper_class

if TYPE_CHECKING:
    from ray.serve.schema import ServeDeploySchema

# Of a model family: the modules that it needs, the variables one of which names a checkout in place of the first of
# these, and the file in requirements/ that installs the rest.
_NEEDS: dict[str, tuple[tuple[str, ...], tuple[str, ...], str]] = {
    "diffusion_policy": (("diffusion_policy", "torch"), ("DIFFUSION_POLICY_SRC",), "diffusion_policy.txt"),
    "lerobot": (("lerobot", "torch"), (), "lerobot.txt"),
    "octo": (("octo", "jax"), ("OCTO_SRC",), "octo.txt"),
    "openpi": (("openpi", "jax"), ("OPENPI_SRC",), "openpi.txt"),
    "openvla": (("prismatic", "transformers", "torch"), ("OPENVLA_SRC", "OPENVLA_OFT_SRC"), "openvla.txt"),
    "openvla_oft": (("prismatic", "transformers", "torch"), ("OPENVLA_OFT_SRC", "OPENVLA_SRC"), "openvla.txt"),
    "pi0": (("transformers", "torch"), (), "hf.txt"),
    "vjepa2_ac": (("transformers", "torch"), ("VJEPA2_SRC",), "hf.txt"),
    "arro": (("transformers", "torch"), (), "hf.txt"),
}
_CHECKOUTS = {"VJEPA2_SRC": "src"}  # whose module is not among the first ones


def policy_lines() -> Iterator[str]:
    """Say of each policy and wrapper what it is, what is missing here and how to get it, and its settings."""
    for kind, find in (("policies", policy_class), ("wrappers", wrapper_class)):
        yield f"{kind}, for `policy`:" if kind == "policies" else "wrappers, for `wrappers`:"
        for name, target in sorted(names(kind).items()):
            try:
                cls = find(name)
            except VLAgentsError as error:
                yield from ("", name, f"  not here: {error}")
                continue
            missing = missing_packages(name)
            yield from (
                "",
                f"{name}: {_first_line(sys.modules[target.partition(':')[0]])}",
                f"  {'ready' if missing is None else missing}",
            )
            yield f"  settings: {', '.join(settings_of(cls)) or 'none'}"
        yield ""


def require_packages(config: ServeDeploySchema) -> None:
    """Raise `MissingDependency` if a policy that is to run in this environment lacks packages here.

    A checkout of its source is not looked for: a setting may name one.
    """
    for app in config.applications:
        name, environment = str(app.args.get("policy")), app.args.get("environment")
        if not environment and not app.runtime_env and (missing := missing_packages(name, checkout=False)) is not None:
            raise MissingDependency(f"policy {name!r}: {missing}")


def missing_packages(name: str, *, checkout: bool = True) -> str | None:
    """Say what a model family needs that this environment has not, with the cure; None if nothing.

    Args:
        name: The name of the policy or wrapper.
        checkout: Whether the checkout that some families need counts.
    """
    modules, variables, requirements = _NEEDS.get(name, ((), (), ""))
    sources = [variable for variable in variables if os.environ.get(variable)]
    needed = [one for one in modules if not (sources and one == modules[0] and variables[0] not in _CHECKOUTS)]
    lacking = [one for one in needed if importlib.util.find_spec(one) is None]
    no_source = bool(variables) and not sources and (variables[0] in _CHECKOUTS or modules[0] in lacking)
    own_module = no_source and variables[0] not in _CHECKOUTS
    if not lacking[own_module:] and not (no_source and checkout):
        return None
    cures = [f"`vlagents-ray env make requirements/{requirements}`, and that Python in `environment` of its deployment"]
    if no_source:
        cures.append(f"{' or '.join(variables)}=FOLDER of a checkout")
        lacking = [*lacking[own_module:], "its source"]
    return f"not in this environment ({', '.join(lacking)}): {'; '.join(cures)}"


def settings_of(cls: type) -> Iterator[str]:
    """Return each setting as `name=default`, or its name alone if it is required."""
    fields: Mapping[str, Any] | None = getattr(getattr(cls, "Config", None), "model_fields", None)
    if fields is not None:
        for name, field in fields.items():
            yield name if field.is_required() else f"{name}={field.get_default(call_default_factory=True)!r}"
        return
    for parameter in inspect.signature(cls).parameters.values():
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
            required = parameter.default is parameter.empty
            yield parameter.name if required else f"{parameter.name}={parameter.default!r}"


def env_lines() -> Iterator[str]:
    """Say of each simulator what keeps it from running here, with the cure, and its tasks, in a line each."""
    for name in sorted(names("envs")):
        try:
            cls = env_class(name)
            missing, tasks = cls.missing(), cls.tasks()
        except VLAgentsError as error:
            missing, tasks = str(error), []
        yield f"{name}: {'ready' if missing is None else missing}"
        yield f"  {len(tasks)} tasks: {', '.join(ranges(tasks))}" if tasks else "  tasks: any that the simulator knows"


def ranges(tasks: list[str]) -> Iterator[str]:
    """Join numbered names of one kind: "libero_spatial/0" to "libero_spatial/9" as "libero_spatial/0..9"."""
    split = [re.fullmatch(r"(.*/)(\d+)", task) for task in tasks]
    for stem, group in groupby(zip(tasks, split, strict=True), lambda one: None if one[1] is None else one[1][1]):
        members = list(group)
        numbers = [int(found[2]) for _, found in members if found is not None]
        if stem is not None and len(numbers) > 1 and numbers == list(range(numbers[0], numbers[-1] + 1)):
            yield f"{stem}{numbers[0]}..{numbers[-1]}"
        else:
            yield from (task for task, _ in members)


def _first_line(module: ModuleType) -> str:
    return (module.__doc__ or "").strip().partition("\n")[0]
