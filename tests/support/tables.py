"""Write the files that this repository contains although they are generated: `python
tests/support/tables.py`.

These are the table of policies in README.md, between `<!-- table: policies -->` and `<!-- /table
-->`; `published.json`, the distribution of each name that a plug-in registers; and examples/plugin,
from the skeleton of `vlagents-ray init plugin`.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import tomllib

# For the script; pytest has its own list of such folders.
sys.path.append(str(Path(__file__).parents[2] / "docs/generate"))

from generated import policies, properties
from reference import ROOT

from vlagents_ray.cli.init import render

README = ROOT / "README.md"
PUBLISHED = ROOT / "vlagents_ray" / "published.json"
PLUGIN, PLUGIN_NAME = ROOT / "examples" / "plugin", "homing"
_BEGIN, _END = "<!-- table: policies -->", "<!-- /table -->"
_RAPTOR = "a recurrent policy for quadrotors by its authors' weights, in one short file"
_OWN_POLICY = "a class with `initialize`, `reset` and `act`"


def with_table(readme: str) -> str:
    """Return the text of README.md with its table of policies."""
    if readme.count(_BEGIN) != 1:
        raise ValueError(f"{README.name}: expected {_BEGIN} once, and {_END} after its table")
    rows = [
        *policies("docs/policies/"),
        f"| [RAPTOR](docs/tutorials/raptor.md) | {_RAPTOR} | PyPI | {properties('RAPTOR')} |",
        f"| [your own](docs/own_policy.md) | {_OWN_POLICY} | `vlagents-ray init policy NAME` |  |",
    ]
    table = "\n".join([_BEGIN, *rows, _END])
    return re.sub(f"{_BEGIN}.*?{_END}", lambda _: table, readme, flags=re.DOTALL)


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


def main() -> None:
    README.write_text(with_table(README.read_text()))
    PUBLISHED.write_text(published())
    for path, text in example_plugin().items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


if __name__ == "__main__":
    main()
