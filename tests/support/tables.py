"""Write the tables of README and docs/ that are generated from the code: `python
tests/support/tables.py`. The script also writes examples/plugin, from the skeleton of `vlagents-ray
init plugin`, and published.json.

The tables come from the registry, from lists in the code and from the recorded outcomes of tests,
and are placed between `<!-- table: NAME -->` and `<!-- /table -->`. The pages in the navigation of
mkdocs.yml are generated in the same way.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import tomllib
from programs import others, ran, settings
from verified import FURTHER_PAGES, RUN_WITH, marked, notes

from vlagents_ray.cli.init import render
from vlagents_ray.evaluate import exports
from vlagents_ray.evaluate.results.statistics import wilson
from vlagents_ray.registry import CORE, RegistryEntry, entries

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "vlagents_ray" / "published.json"
PLUGIN, PLUGIN_NAME = ROOT / "examples" / "plugin", "homing"
# Success rates, which the tests named in the file reproduce.
RATES = json.loads((ROOT / "tests/rates.json").read_text())
# Success rates of the reference policy by simulator.
LEARNT = json.loads((ROOT / "examples/reference/checkpoint/rates.json").read_text())
# Results of serving the reference policy, from `benchmarks.success`.
SERVING_RESULTS = json.loads((ROOT / "examples/reference/success.json").read_text())["ways"]


def _listed(registered: dict[str, RegistryEntry]) -> Iterator[tuple[str, RegistryEntry]]:
    return ((name, entry) for name, entry in registered.items() if entry.about)


def _link(name: str, text: str, one: RegistryEntry, folder: str) -> str:
    page = name if one.page is None else one.page
    file, at, anchor = page.partition("#")
    return f"[{text}]({folder}{file}.md{at}{anchor})" if page else text


def _code(words: Iterable[str]) -> str:
    return ", ".join(f"`{word}`" for word in words)


def folder_of(entry: RegistryEntry) -> str:
    """Return the folder in the checkout of the distribution that registers an entry."""
    return "." if entry.distribution == CORE else f"plugins/{entry.distribution.replace('-', '_')}"


def published() -> str:
    """Return the text of published.json: the distribution of each name that this repository's
    plug-ins register.
    """
    kinds: dict[str, dict[str, str]] = {}
    for file in sorted(ROOT.glob("plugins/*/pyproject.toml")):
        project = tomllib.loads(file.read_text())["project"]
        for group, points in project.get("entry-points", {}).items():
            kind = kinds.setdefault(group.removeprefix("vlagents_ray."), {})
            kind.update(dict.fromkeys(points, project["name"]))
    return json.dumps(kinds, indent=2, sort_keys=True) + "\n"


def example_plugin() -> dict[Path, str]:
    """Return the text of each file of examples/plugin, as `vlagents-ray init plugin homing` writes
    it.
    """
    return {
        PLUGIN / path.relative_to(PLUGIN_NAME): text
        for path, text in render(PLUGIN_NAME, "plugin").items()
    }


def page_of(name: str, entry: RegistryEntry) -> str:
    """Return the name of the page of a policy or an environment; empty if it has no page."""
    return name if entry.page is None else entry.page.partition("#")[0]


def section(folder: str, page: str) -> str:
    """Return the text of a page of docs/, given as `page` or, for one section of it, as
    `page#anchor`.
    """
    name, _, anchor = page.partition("#")
    text = (ROOT / "docs" / folder / f"{name}.md").read_text()
    if not anchor:
        return text
    for part in re.split(r"^(?=## )", text, flags=re.MULTILINE):
        if re.sub(r"[^\w-]", "", part.partition("\n")[0][3:].lower().replace(" ", "-")) == anchor:
            return part
    raise ValueError(f"docs/{folder}/{name}.md: got no heading of the second level for #{anchor}")


def share(solved: int, episodes: int, digits: int = 0) -> str:
    """Return a success rate in per cent, with its confidence interval."""
    values = (solved / episodes, *wilson(solved, episodes))
    rate, low, high = (f"{100 * value:.{digits}f}" for value in values)
    return f"{rate} [{low}, {high}]"


def total(simulator: str) -> tuple[int, int]:
    """Return the number of episodes that the reference policy solved in a simulator, and the number
    of all episodes.
    """
    solved, episodes = map(sum, zip(*LEARNT[simulator].values(), strict=True))
    return solved, episodes


def verified(name: str, family: str = "") -> str:
    """Return the verified properties of a policy; `family` is its folder in tests/families."""
    rate = RATES.get(name, {})
    if name == "reference":
        rate = dict(zip(("successes", "episodes"), total("tabletop"), strict=True))
    if "successes" in rate:
        return f"✓ {share(rate['successes'], rate['episodes'])} % of {rate['episodes']}"
    parity = {test for test, what in marked(family) if what == "parity"} if family else set()
    cases = (
        [one["tests"].get(test, {}).get("passed", 0) for one in notes(family) for test in parity]
        if parity
        else []
    )
    return "◇" if any(cases) or rate.get("equal") else "○"


def policies(folder: str = "") -> Iterator[str]:
    """Yield the rows of the policies; `folder` is the relative path to docs/policies."""
    yield from ("| policy | models | source | verified |", "|---|---|---|---|")
    for name, one in _listed(entries("policies")):
        source = f"a checkout, {_code(one.checkouts)}" if one.checkouts else "PyPI"
        said = verified(name, name if name in RUN_WITH else page_of(name, one))
        yield (
            f"| {_link(name, f'`{name}`', one, folder)} | {one.about} | {one.wants or source} | "
            f"{said} |"
        )


def simulated(name: str) -> str:
    """Return the verified properties of an environment."""
    if name in LEARNT:
        solved, episodes = total(name)
        return f"✓ {share(solved, episodes)} % of {episodes}"
    expert = RATES["simulators"].get(name)
    return "○" if expert is None else f"◇ {expert['solved']} of {expert['episodes']}"


def environments(folder: str = "") -> Iterator[str]:
    """Yield the rows of the environments; `folder` is the relative path to docs/benchmarks."""
    yield from ("| environment | tasks | needs | verified |", "|---|---|---|---|")
    for name, one in _listed(entries("envs")):
        packages = [f"`'{folder_of(one)}[{one.extra}]'`"] if one.extra else []
        packages += [f"`venv create {name}`" for name in one.requirements]
        wants = "; ".join(filter(None, (" or ".join(packages), one.wants)))
        yield (
            f"| {_link(name, f'`{name}{one.tasks}`', one, folder)} | {one.about} | {wants} | "
            f"{simulated(name)} |"
        )


def rates() -> Iterator[str]:
    """Yield the success rates of the reference policy by task, one row each."""
    yield from ("| task | success, % | episodes |", "|---|---|---|")
    for tasks in LEARNT.values():
        for env, (solved, episodes) in tasks.items():
            yield f"| `{env}` | {share(solved, episodes, 1)} | {episodes} |"


def ways() -> Iterator[str]:
    """Yield the rows of the transports and settings with which the reference policy was served."""
    yield from ("| setting | success, % | difference | p | equal |", "|---|---|---|---|---|")
    for row in SERVING_RESULTS:
        off, low, high = (
            f"{100 * value:+.1f}" for value in (row["difference"], *row["difference_95"])
        )
        equal = "all" if row["equal"] == row["episodes"] else row["equal"]
        rate = share(row["solved"], row["episodes"], 1)
        yield f"| {row['way']} | {rate} | {off} [{low}, {high}] | {row['p_holm']:.2g} | {equal} |"


def columns() -> Iterator[str]:
    """Yield the rows of the table of an export's columns."""
    yield from ("| column | type | meaning |", "|---|---|---|")
    for column in exports.COLUMNS:
        yield f"| `{column.name}` | {column.type} | {column.meaning} |"


_RAPTOR = (
    "a recurrent policy for quadrotors by its authors' weights, in one short file | PyPI | "
    f"{verified('RAPTOR')}"
)
_OWN_POLICY = "a class with `initialize`, `reset` and `act` | `vlagents-ray init policy NAME` | "
TABLES: dict[str, dict[str, list[str]]] = {
    "README.md": {
        "policies": [
            *policies("docs/policies/"),
            f"| [RAPTOR](docs/tutorials/raptor.md) | {_RAPTOR} |",
            f"| [your own](docs/own_policy.md) | {_OWN_POLICY} |",
        ],
    },
    "docs/policies/index.md": {"policies": list(policies())},
    "docs/policies/reference.md": {"rates": list(rates())},
    "docs/measured_success.md": {"success": list(ways())},
    "docs/programs.md": {
        "programs": list(ran()),
        "settings": list(settings()),
        "others": list(others()),
    },
    "docs/evaluation/exports.md": {"columns": list(columns())},
    "docs/benchmarks/index.md": {"environments": list(environments())},
}


def with_tables(file: str, text: str) -> str:
    """Return the text of a page with its tables, or the text of mkdocs.yml with the pages of the
    policies and the environments.
    """
    if file == "mkdocs.yml":
        for folder, registered, further in (
            ("policies", entries("policies"), FURTHER_PAGES),
            ("benchmarks", entries("envs"), ()),
        ):
            names = dict.fromkeys(page_of(name, entry) for name, entry in _listed(registered))
            pages = "".join(f"      - {folder}/{page}.md\n" for page in (*names, *further) if page)
            index = f"      - {folder}/index.md\n"
            text = re.sub(
                f"{index}(?:      - {folder}/.*\n)*", lambda _, new=index + pages: new, text
            )
        return text
    for name, rows in TABLES[file].items():
        begin, end = f"<!-- table: {name} -->", "<!-- /table -->"
        if text.count(begin) != 1:
            raise ValueError(f"{file}: expected {begin} once, and {end} after its table")
        new = "\n".join([begin, *rows, end])
        text = re.sub(f"{begin}.*?{end}", lambda _, new=new: new, text, flags=re.DOTALL)
    return text


def main() -> None:
    for file in (*TABLES, "mkdocs.yml"):
        path = ROOT / file
        path.write_text(with_tables(file, path.read_text()))
    PUBLISHED.write_text(published())
    for path, text in example_plugin().items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


if __name__ == "__main__":
    main()
