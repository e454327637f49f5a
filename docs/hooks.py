"""Hooks of MkDocs that write the generated parts of pages, and add pages and files from outside
docs/ to the site, at their paths in the repository.

Links in the Markdown are relative paths in the repository, so that they also work in a checkout and
on GitHub. On the site, docs/ is the root, and a link to a file outside docs/ leads to a copy of
that file.
"""

from __future__ import annotations

import posixpath
import re
import sys
import warnings
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

# The generated parts come from the code, and from the results of tests and measurements.
sys.path.append(str(Path(__file__).parent / "generate"))
sys.path.append(str(Path(__file__).parents[1] / "tests/support"))
import generated

ROOT = Path(__file__).parents[1]
PAGES = (
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "CODE_OF_CONDUCT.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "clients/cpp/README.md",
    "examples/README.md",
    "examples/experts/README.md",
    "tests/README.md",
)
_LINK = re.compile(r"\[(?P<text>[^\]]*)\]\((?P<path>(?!\w+:)[^)#\s]+)(?P<anchor>#[^)\s]*)?\)")
_ABOVE_A_BLOCK = re.compile(r"^ *<!--(?:(?!-->).)*-->\n(?= *```)", re.DOTALL | re.MULTILINE)


def filled(text: str) -> str:
    """Return the text of a page with its generated parts, without the warnings of modules that are
    imported for them.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return generated.filled(text)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages outside docs/, and every file outside docs/ that a page links to."""
    for name in PAGES:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    for file in list(files.documentation_pages()):
        for link in _LINK.finditer(filled(file.content_string)):
            path = _path(file.src_uri, link["path"])
            if (
                not path.startswith("docs/")
                and (ROOT / path).is_file()
                and path not in files.src_uris
            ):
                if path.endswith(".md"):
                    raise PluginError(
                        f"{file.src_uri} links to {path}: add that page to PAGES of docs/hooks.py, "
                        "and to mkdocs.yml"
                    )
                files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Write the generated parts, remove comments that only tests read, and rewrite links to the
    paths on the site.
    """
    here = page.file.src_uri

    def turned(link: re.Match[str]) -> str:
        path = _path(here, link["path"])
        if (ROOT / path).is_dir():
            return link["text"]  # the site has no listings of folders
        uri = posixpath.relpath(path.removeprefix("docs/"), posixpath.dirname(here) or ".")
        return f"[{link['text']}]({uri}{link['anchor'] or ''})"

    return _LINK.sub(turned, _ABOVE_A_BLOCK.sub("", filled(markdown)))


def on_nav(nav: Any, config: Any, files: Files) -> None:
    """Write llms.txt, an index of all pages for language models, with the subject of each page."""
    lines = [f"# {config['site_name']}", "", f"> {config['site_description']}"]
    for section in nav.items:
        lines += ["", f"## {section.title}", ""]
        lines += [_entry(page) for page in (section, *_pages(section)) if page.is_page]
    files.append(File.generated(config, "llms.txt", content="\n".join([*lines, ""])))


def _pages(section: Any) -> list[Any]:
    """Return the pages of a section and of its subsections."""
    return [page for child in section.children or [] for page in (child, *_pages(child))]


def _entry(page: Any) -> str:
    """Return a page's line in llms.txt: its title, its path, and its first sentence, which
    generated HTML pages lack.
    """
    if not page.file.is_documentation_page():
        return f"- [{page.title}]({page.file.dest_uri})"
    title, _, rest = (
        re.sub(r"<!--.*?-->", "", page.file.content_string, flags=re.DOTALL)
        .lstrip("# \n")
        .partition("\n")
    )
    prose = next(
        (block for block in rest.split("\n\n") if re.match(r"\s*(?!```)[\w`*\[]", block)), ""
    )
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(prose.split()))
    about = re.split(r"(?<=\.) (?=[A-Z`])", plain)[0].removesuffix(":")
    return f"- [{title.strip()}]({page.file.dest_uri})" + (f": {about}" if about else "")


def _path(page: str, link: str) -> str:
    """Return the path in the repository of the target of a link."""
    folder = posixpath.dirname(page if page in PAGES else f"docs/{page}")
    return posixpath.normpath(posixpath.join(folder, link))
