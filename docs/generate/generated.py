"""The parts of pages that are written when the site is built.

On a page such a part stands between `<!-- generated: NAME -->` and `<!-- /generated -->`. The text
between these comments is for readers of the Markdown, for whom it says where they find the same;
`filled` puts the part in its place. The parts come from the registry, from lists in the code, and
from measurements in JSON files.
"""

from __future__ import annotations

import functools
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import programs
import reference
import resolved
import verified
import yaml
from reference import ROOT, folder_of, own_entries

from vlagents_ray.evaluate import exports
from vlagents_ray.registry import RegistryEntry
from vlagents_ray.success import wilson

# Success rates, which the tests named in the file reproduce.
RATES = json.loads((ROOT / "tests/rates.json").read_text())
# Success rates of the reference policy by simulator.
LEARNT = json.loads((ROOT / "examples/reference/checkpoint/rates.json").read_text())
_PART = re.compile(
    r"^<!-- generated: (?P<name>[\w ]+) -->\n(?:(?!<!-- generated).)*?^<!-- /generated -->$",
    re.DOTALL | re.MULTILINE,
)


def filled(text: str) -> str:
    """Return the text of a page with its generated parts.

    Raises:
        ValueError: A part has no name of `PARTS`, or no end.
    """
    found = _PART.sub(lambda part: _text(part["name"]), text)
    if re.search(r"^ *<!-- /?generated", found, re.MULTILINE):
        raise ValueError(
            "expected <!-- generated: NAME --> with <!-- /generated --> after it, got one of them"
        )
    return found


@functools.cache
def _text(name: str) -> str:
    if name not in PARTS:
        raise ValueError(f"expected a generated part of {sorted(PARTS)}, got {name!r}")
    lines = PARTS[name]()
    return lines if isinstance(lines, str) else "\n".join(lines)


# Policies and environments.


def page_of(name: str, entry: RegistryEntry) -> str:
    """Return the name of the page of a policy or an environment; empty if it has no page."""
    return name if entry.page is None else entry.page.partition("#")[0]


def share(solved: int, episodes: int, digits: int = 0) -> str:
    """Return a success rate in per cent, with its confidence interval."""
    values = (solved / episodes, *wilson(solved, episodes))
    rate, low, high = (f"{100 * value:.{digits}f}" for value in values)
    return f"{rate} [{low}, {high}]"


def policies(folder: str = "") -> Iterator[str]:
    """Yield the rows of the policies; `folder` is the relative path to docs/policies."""
    yield from ("| policy | models | source | verified |", "|---|---|---|---|")
    for name, entry in _listed("policies"):
        source = f"a checkout, {_code(entry.checkouts)}" if entry.checkouts else "PyPI"
        family = name if name in verified.RUN_WITH else page_of(name, entry)
        link = _link(name, f"`{name}`", entry, folder)
        yield (f"| {link} | {entry.about} | {entry.wants or source} | {properties(name, family)} |")


def environments() -> Iterator[str]:
    """Yield the rows of the environments, with links from docs/benchmarks."""
    yield from ("| environment | tasks | needs | verified |", "|---|---|---|---|")
    for name, entry in _listed("envs"):
        packages = [f"`'{folder_of(entry)}[{entry.extra}]'`"] if entry.extra else []
        packages += [f"`venv create {requirements}`" for requirements in entry.requirements]
        needs = "; ".join(filter(None, (" or ".join(packages), entry.wants)))
        link = _link(name, f"`{name}{entry.tasks}`", entry)
        yield f"| {link} | {entry.about} | {needs} | {_simulated(name)} |"


def properties(name: str, family: str = "") -> str:
    """Return the verified properties of a policy; `family` is its folder in tests/families."""
    rate = RATES.get(name, {})
    if name == "reference":
        rate = dict(zip(("successes", "episodes"), _total("tabletop"), strict=True))
    if "successes" in rate:
        return f"✓ {share(rate['successes'], rate['episodes'])} % of {rate['episodes']}"
    passed = 0
    for test, property_ in verified.marked(family) if family else ():
        if property_ == "parity":
            results = (note["tests"].get(test, {}) for note in verified.notes(family))
            passed += sum(outcomes.get("passed", 0) for outcomes in results)
    return "◇" if passed or rate.get("equal") else "○"


def rates() -> Iterator[str]:
    """Yield the success rates of the reference policy by task, one row each."""
    yield from ("| task | success, % | episodes |", "|---|---|---|")
    for tasks in LEARNT.values():
        for env, (solved, episodes) in tasks.items():
            yield f"| `{env}` | {share(solved, episodes, 1)} | {episodes} |"


def _listed(kind: str) -> Iterator[tuple[str, RegistryEntry]]:
    return ((name, entry) for name, entry in own_entries(kind).items() if entry.about)


def _link(name: str, text: str, entry: RegistryEntry, folder: str = "") -> str:
    file, hash_sign, anchor = (name if entry.page is None else entry.page).partition("#")
    return f"[{text}]({folder}{file}.md{hash_sign}{anchor})" if file else text


def _code(words: Iterable[str]) -> str:
    return ", ".join(f"`{word}`" for word in words)


def _total(simulator: str) -> tuple[int, int]:
    """Return the number of episodes that the reference policy solved in a simulator, and the number
    of all episodes.
    """
    solved, episodes = map(sum, zip(*LEARNT[simulator].values(), strict=True))
    return solved, episodes


def _simulated(name: str) -> str:
    """Return the verified properties of an environment."""
    if name in LEARNT:
        solved, episodes = _total(name)
        return f"✓ {share(solved, episodes)} % of {episodes}"
    expert = RATES["simulators"].get(name)
    return "○" if expert is None else f"◇ {expert['solved']} of {expert['episodes']}"


# What the tests of model families verify.


def verification() -> Iterator[str]:
    """Yield the table of all families, and the list of their tests that did not run."""
    yield f"| policy | {' | '.join(verified.WHAT)} | versions |"
    yield f"|---|{'---|' * len(verified.WHAT)}---|"
    not_run = list[str]()
    for family in verified.RUN_WITH:
        tests = dict(verified.marked(family))
        for results in [note for note in verified.notes(family) if note["tests"]] or [None]:
            yield _row_of_family(family, tests, results)
            if results is not None:
                not_run += _reasons(family, tests, results)
    yield from ("", "Tests that did not run:", "", *not_run)


def _row_of_family(family: str, tests: Mapping[str, str], results: Mapping[str, Any] | None) -> str:
    """Return the row of a family for one Python version.

    Args:
        family: The name of the family.
        tests: The property that each test verifies.
        results: The outcomes of these tests; None if they have not run.
    """
    entry = own_entries("policies").get(family)
    link = f"[`{family}`]({family}.md)" if entry is None else _link(family, f"`{family}`", entry)
    if results is None:
        return f"| {link} | {' | ' * len(verified.WHAT)}not run |"
    cells = []
    for column in verified.WHAT:
        names = [name for name, property_ in tests.items() if property_ == column]
        outcomes = sum((Counter(results["tests"].get(name, {})) for name in names), Counter[str]())
        passed = outcomes.pop("passed", 0)
        others = [f"{number} {outcome}" for outcome, number in sorted(outcomes.items())]
        cells.append(", ".join([str(passed)] * bool(passed) + others))
    return f"| {link} | {' | '.join(cells)} | {_environment_of(results)} |"


def _environment_of(results: Mapping[str, Any]) -> str:
    absent = ("not set", "not installed")
    versions = [
        f"{f'`{name}`' if name.isupper() else name} {number}"
        for name, number in results["versions"].items()
        if number not in absent
    ]
    return ", ".join([f"Python {results['python']}", *versions, "on " + results["device"]])


def _reasons(family: str, tests: Mapping[str, str], results: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each reason why marked tests of a family were skipped or not run."""
    files_by_reason: dict[str, list[str]] = {}
    for name in tests:
        file = name.partition("::")[0]
        if name not in results["tests"]:
            newer = "tests that are newer than these results"
            reason = results.get("left_out", {}).get(file, newer)
        elif name in results.get("skipped", {}):
            reason = results["skipped"][name]
        else:
            continue
        files = files_by_reason.setdefault(reason, [])
        if f"`{file}`" not in files:
            files.append(f"`{file}`")
    for reason, files in files_by_reason.items():
        yield f"- `{family}`, Python {results['python']}, {', '.join(files)}: {reason}."


# Programs of other projects.


def programs_run() -> Iterator[str]:
    """Yield the rows of the table of programs, one for each Python with which a program was
    tested.
    """
    yield "| program | versions | from | connects to | tests | advice |"
    yield "|---|---|---|---|---|---|"
    notes = programs.notes()
    for name, program in programs.PROGRAMS.items():
        for note in notes.get(name, {"": {}}).values():
            outcomes = ", ".join(
                f"{note[outcome]} {outcome}"
                for outcome in ("passed", "failed", "skipped")
                if outcome in note
            )
            cells = (
                name,
                note.get("versions", ""),
                program.source,
                program.connects,
                outcomes or "not run",
                program.said,
            )
            yield f"| {' | '.join(cells)} |"


def settings_of_programs() -> Iterator[str]:
    """Yield a YAML block with the dialects of each program's server."""
    yield "```yaml"
    for name, program in programs.PROGRAMS.items():
        if program.dialects:
            yield f"# {name}"
            yield yaml.safe_dump(
                dict(program.dialects), sort_keys=False, default_flow_style=None, width=110
            ).rstrip()
    yield "```"


# Other tables.


def ways() -> Iterator[str]:
    """Yield the rows of the transports and settings with which the reference policy was served,
    from `benchmarks.success`.
    """
    yield from ("| setting | success, % | difference | p | equal |", "|---|---|---|---|---|")
    for row in json.loads((ROOT / "examples/reference/success.json").read_text())["ways"]:
        off, low, high = (
            f"{100 * value:+.1f}" for value in (row["difference"], *row["difference_95"])
        )
        equal = "all" if row["equal"] == row["episodes"] else row["equal"]
        rate = share(row["solved"], row["episodes"], 1)
        yield f"| {row['way']} | {rate} | {off} [{low}, {high}] | {row['p_holm']:.2g} | {equal} |"


def successful_robots() -> Iterator[str]:
    """Yield the rows of the largest fleets of successful robots, and of the tasks per GPU-hour if
    the success of the policy was measured, from `tests.simulation.robots`.
    """
    found = json.loads((ROOT / "tests/simulation/successful.json").read_text())
    delays = list(found["systems"][0]["largest"])
    yield f"| rows of a chunk | server and loop | {' | '.join(f'd* = {rows}' for rows in delays)} |"
    yield "|---" * (2 + len(delays)) + "|"
    for system in found["systems"]:
        cells = [system["rows"], system["system"], *system["largest"].values()]
        yield f"| {' | '.join(map(str, cells))} |"

    if not all(found["curves"].values()):
        return
    yield ""
    loads = ("25 %", "70 %", "105 %")
    yield f"| rows of a chunk | server and loop | {' | '.join(loads)} of the capacity |"
    yield "|---" * (2 + len(loads)) + "|"
    for system in found["systems"]:
        cells = [system["rows"], system["system"]]
        for fleet in system["fleets"]:
            tasks = round(fleet["tasks_per_gpu_hour"])
            cells.append(f"{fleet['successful']} of {fleet['robots']}: {tasks:,}")
        yield f"| {' | '.join(map(str, cells))} |"


def delays() -> Iterator[str]:
    """Yield the tables of success by delay, from `benchmarks.delays`, one for each environment."""
    heads = (
        "mode",
        "rows",
        "success, %",
        "difference",
        "equal",
        "ticks",
        "standing, %",
        "tasks an hour",
        "jerk",
        "oscillation",
    )
    found = json.loads((ROOT / "examples/reference/delays.json").read_text())
    for title, measured in found.items():
        yield f"**{title}**, {measured['hz']:g} Hz:"
        yield ""
        yield f"| {' | '.join(heads)} |"
        yield "|---" * len(heads) + "|"
        for row in measured["rows"]:
            off, low, high = (
                f"{100 * value:+.1f}" for value in (row["difference"], *row["difference_95"])
            )
            cells = (
                row["mode"],
                row["delay"],
                f"{share(row['solved'], row['episodes'], 1)} of {row['episodes']}",
                f"{off} [{low}, {high}]",
                "all" if row["equal"] == row["episodes"] else str(row["equal"]),
                f"{row['ticks']:.1f}",
                f"{100 * row['standing']:.0f}",
                f"{row['tasks_per_hour']:.0f}",
                f"{row['jerk']:.1f}",
                f"{1e3 * row['oscillation']:.1f}",
            )
            yield f"| {' | '.join(cells)} |"
        yield ""


def columns() -> Iterator[str]:
    """Yield the rows of the table of an export's columns."""
    yield from ("| column | type | meaning |", "|---|---|---|")
    for column in exports.COLUMNS:
        yield f"| `{column.name}` | {column.type} | {column.meaning} |"


def packages_of_extras() -> Iterator[str]:
    """Yield the rows of the extras with the number of their packages for each Python."""
    heads = ["extra", *(f"Python {python}" for python in resolved.PYTHONS), "* compiled"]
    yield f"| {' | '.join(heads)} |"
    yield "|---" * len(heads) + "|"
    for extra, found in resolved.notes().items():
        name = extra if extra == "none" else f"`{extra}`"
        counts = [found["packages"][python] for python in resolved.PYTHONS]
        yield f"| {' | '.join([name, *counts, _code(found['compiled'])])} |"


# The parts by their name on the pages.
PARTS: dict[str, Callable[[], str | Iterable[str]]] = {
    "commands": reference.commands,
    "run file": reference.run_file,
    "deployment file": reference.deployment_file,
    "settings of policies": reference.policy_settings,
    "policies": policies,
    "environments": environments,
    "rates": rates,
    "verification": verification,
    "programs": programs_run,
    "settings of programs": settings_of_programs,
    "success": ways,
    "successful robots": successful_robots,
    "delays": delays,
    "columns": columns,
    "extras": packages_of_extras,
}
