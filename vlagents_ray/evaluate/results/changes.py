"""Detection of changes in the files, settings and weights of an evaluation's policies and
environments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from vlagents_ray.evaluate.plan.config import canonical, fingerprint
from vlagents_ray.policies.base.program import SOFTWARE

IDENTITY = ("policy", "checkpoint", "weights")  # names of fields in a policy's metadata
# Settings that the field "checkpoint" already covers.
_OF_CHECKPOINT = {"checkpoint", "checkpoint_step"}
_SWEPT = "checkpoint: "  # prefix of the names of the files that belong to a step of a sweep
PLAN = "plan"  # the subject of a change of the plan
_DIGITS = 12  # number of digits of a digest that are printed
MIX = (
    "restore the old files, choose a new folder (--out), or mix both, which the report will "
    "mention (--accept-changes)"
)


class EnvStatement(NamedTuple):
    """The description and the contract of an environment, as JSON values; both are empty if no
    worker has created the environment.
    """

    description: Mapping[str, Any]  # `EvalEnv.describe()`, such as the simulator's version
    contract: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Change:
    """A file, a digest or a setting that differs from earlier episodes."""

    subject: str  # "env my_envs:Reach", "policy pi0", "software", or "plan"
    name: str  # the name of the file or the setting
    was: str | None  # the earlier digest or value; None if there was no value
    now: str | None  # the present digest or value; None if there is no value

    @property
    def is_of_plan(self) -> bool:
        """Whether the plan changed, i.e. which episodes were run, not how."""
        return self.subject == PLAN

    def is_statement_of(self, env: str) -> bool:
        """Return whether this is a change of the description or the contract of the env (see
        `env_changes`).
        """
        prefixes = tuple(f"its {field} " for field in EnvStatement._fields)
        return self.subject == f"env {env}" and self.name.startswith(prefixes)

    def is_setting_of(self, policy: str) -> bool:
        """Return whether this is a change of the settings of the policy or its wrappers (see
        `policy_changes`).
        """
        return self.subject == f"policy {policy}" and self.name.startswith("its ")

    def __str__(self) -> str:
        return f"{self.subject}: {self.name} was {short(self.was)}, is {short(self.now)}"


def listed(changes: Sequence[Change]) -> str:
    """Return the list of changes for an error message, one line for each change."""
    return "\n".join(f"- {change}" for change in changes)


def program_changes(
    subject: str, was: Mapping[str, str] | None, now: Mapping[str, str] | None
) -> list[Change]:
    """Return the changes between two programs; empty if one of the programs is None.

    The subject of a change of the software that runs the episodes is "software", since it concerns
    every environment.
    """
    if was is None or now is None:
        return []
    changes = []
    for name in sorted(was.keys() | now.keys()):
        if was.get(name) != now.get(name):
            is_software = name.startswith(SOFTWARE) and subject.startswith("env ")
            of = "software" if is_software else subject
            changes.append(Change(of, name.removeprefix(SOFTWARE), was.get(name), now.get(name)))
    return changes


def env_changes(env: str, was: EnvStatement, now: EnvStatement) -> list[Change]:
    """Return the changes between two descriptions and contracts of an environment; empty values are
    not compared.
    """
    changes: list[Change] = []
    for field in EnvStatement._fields:
        before, after = getattr(was, field), getattr(now, field)
        if before and after:
            changes += _changed_values(f"env {env}", f"its {field}", before, after)
    return changes


def _changed_values(
    subject: str, of: str, before: Mapping[str, Any], after: Mapping[str, Any]
) -> list[Change]:
    """Return the changes between two mappings. The name of a change is "`of` 'NAME'"."""
    changes = []
    for name in sorted(before.keys() | after.keys()):
        was, now = before.get(name), after.get(name)
        if was != now:
            changes.append(Change(subject, f"{of} {name!r}", repr(was), repr(now)))
    return changes


def changed(was: Mapping[str, Any], now: Mapping[str, Any], *, swept: bool) -> str | None:
    """Return the field of a policy's identity that differs between two metadata of its server; None
    if no field differs.

    In a sweep (`swept`), the server has one checkpoint after another, so checkpoints are not
    compared.
    """
    for field in IDENTITY[: 1 if swept else 2]:
        if was.get(field) != now.get(field):
            return field

    changes = policy_changes("", was, now, swept=swept)
    if not changes:
        return None
    return "weights" if changes[-1].name == "weights" else "program"


def policy_changes(
    subject: str, was: Mapping[str, Any], now: Mapping[str, Any], *, swept: bool
) -> list[Change]:
    """Return the changes of files, settings and weights between two metadata of a policy's server.
    A change of the weights is the last entry.
    """
    changes = program_changes(
        subject, policy_program(was, swept=swept), policy_program(now, swept=swept)
    )
    changes += _settings_changes(subject, was, now)

    before = (was.get("weights") or {}).get("digest")
    after = (now.get("weights") or {}).get("digest")
    if not swept and before and after and before != after:
        changes.append(Change(subject, "weights", before, after))
    return changes


def _settings_changes(subject: str, was: Mapping[str, Any], now: Mapping[str, Any]) -> list[Change]:
    """Return the changes between the settings of a policy and its wrappers, as in a deployment
    file.
    """
    changes: list[Change] = []
    before, after = was.get("config"), now.get("config")
    if before is not None and after is not None:
        before = {name: value for name, value in before.items() if name not in _OF_CHECKPOINT}
        after = {name: value for name, value in after.items() if name not in _OF_CHECKPOINT}
        changes += _changed_values(subject, "its setting", before, after)

    before, after = was.get("wrappers"), now.get("wrappers")
    if before is not None and after is not None and before != after:
        changes.append(Change(subject, "its wrappers", canonical(before), canonical(after)))
    return changes


def with_known(now: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metadata `now` of a policy, completed with the program, settings and weights that
    only another server of the policy reports.

    A third server can then be compared with all known values. Otherwise, a server that reports
    nothing would hide a difference between the servers before and after it.
    """
    known = dict(now)
    for name in ("program", "config", "wrappers"):
        if known.get(name) is None and other.get(name) is not None:
            known[name] = other[name]
    if not (known.get("weights") or {}).get("digest") and other.get("weights"):
        known["weights"] = other["weights"]
    return known


def policy_program(metadata: Mapping[str, Any], *, swept: bool) -> dict[str, str] | None:
    """Return the digests of a policy's files by name; None if the server reports no files. In a
    sweep, the files of the checkpoint are left out.
    """
    program = metadata.get("program")
    if program is None:
        return None
    if not swept:
        return dict(program)
    return {name: digest for name, digest in program.items() if not name.startswith(_SWEPT)}


def program_id(program: Mapping[str, str] | None) -> str | None:
    """Return 16 digits that identify a program; None for a program without files."""
    return fingerprint(dict(program)) if program else None


def short(value: str | None) -> str:
    """Return a value of a change for people, with the first digits of a digest."""
    if value is None:
        return "not there"
    method, colon, digits = value.rpartition(":")
    return f"{method}:{digits[:_DIGITS]}" if colon and len(digits) == 64 else value
