"""Reading, running and checking the fenced blocks of a Markdown text, its commands, and the files
of examples/.

An HTML comment straight above a block says how it is tested. `<!-- test: serve scripted -->` runs
it with a server of that policy in place of http://gpu-box:8000 or http://localhost:8000, `<!-- test
-->` or no comment without one; ` with peers` at the end of either runs it with the Python that has
other systems' clients, and ` with ray` says of a block of docs/ that it starts Ray.
Further lines of such a comment are code that is run before the block:

    <!-- test: serve scripted
    obs = Obs(gripper=1.0) -->

`<!-- output -->` above a block of text says that the block before it prints these lines, in this
order and perhaps among others. Numbers are not compared, and `…` matches any text.

`<!-- file: NAME -->` says that the reader saves the block, of whatever language, under that name;
the blocks after it on the page find the file.

`<!-- not run: REASON -->` says why a block is not run; its commands must at least exist, and
`vlagents-ray`'s must know their options. Where blocks run, an `sbatch` takes every job and runs
none.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from peer_environment import peers_python
from typer.main import get_command

from vlagents_ray.cli import robot
from vlagents_ray.cli.main import app
from vlagents_ray_robot.check_command import command_parser as check_parser

ROOT = Path(__file__).parents[2]
DOCUMENTED_HOST = "gpu-box:8000"
ON_THIS_MACHINE = "localhost:8000"
PYTHON, SHELL = {"python"}, {"bash", "sh", "console"}
# As a reader has it, without PYTHONPATH; but if that names this checkout, another one may be what
# is installed.
_HERE = (
    {"PYTHONPATH": str(ROOT)}
    if str(ROOT) in os.environ.get("PYTHONPATH", "").split(os.pathsep)
    else {}
)
_READERS = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | _HERE
_BIN = Path(__file__).parent / "bin"  # commands that a reader has, and this machine may not
ENV = _READERS | {
    "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    "RAY_USAGE_STATS_ENABLED": "0",
    "COLUMNS": "300",  # so that --help does not cut names off
    "TERM": "dumb",
}
RUN_S = 300


@dataclass(frozen=True)
class Block:
    """One fenced block. `source` has its code, and its comment's, at the lines of the README
    where they stand.
    """

    language: str
    line: int
    source: str
    server: str | None = None  # the policy that must be served meanwhile
    not_run: str | None = None  # why it is not run
    peers: bool = False  # it is for the peers' Python
    ray: bool = False  # it starts Ray
    file: str | None = None  # under which name it is saved, in place of being run
    output: str = ""  # the part of its output that the page shows

    def __str__(self) -> str:
        return f"line-{self.line}"


def blocks(text: str) -> list[Block]:
    """The Python and shell blocks of a Markdown text. Raises `ValueError` for an unknown or
    unfinished one.
    """
    found: list[Block] = []
    fence: re.Match[str] | None = None
    comment: list[tuple[int, str]] | None = None
    code: list[tuple[int, str]] = []
    above: list[tuple[int, str]] = []
    for number, line in enumerate(text.splitlines(), 1):
        if fence is not None:
            if line.strip() == "```":
                if fence["language"] in PYTHON | SHELL or (
                    above and above[0][1].lstrip().startswith("<!-- file:")
                ):
                    found.append(_block(fence["language"], above, code))
                elif above and above[0][1].strip() == "<!-- output -->":
                    if not found:
                        raise ValueError(f"line {above[0][0]}: output needs a block before it")
                    shown = "\n".join(line for _, line in code)
                    found[-1] = replace(found[-1], output=shown)
                fence, above, code = None, [], []
            else:
                code.append((number, line.removeprefix(fence["indent"])))
        elif comment is not None or line.lstrip().startswith("<!--"):
            comment = [*(comment or []), (number, line)]
            if "-->" in line:
                above, comment = comment, None
        elif fence := re.match(r"(?P<indent> *)```(?P<language>\w*)", line):
            pass
        else:
            above = []
    if fence is not None or comment is not None:
        raise ValueError("the text ends inside a block or comment")
    return found


def _block(language: str, above: list[tuple[int, str]], code: list[tuple[int, str]]) -> Block:
    mark, setup = "test", []
    if above:
        stripped = [(number, line.replace("<!--", "").replace("-->", "")) for number, line in above]
        mark, setup = stripped[0][1].strip(), stripped[1:]
    kind, _, rest = mark.partition(":")
    server, reason, peers, ray, file = None, None, False, False, None
    if kind == "file" and re.fullmatch(r"\w+\.\w+", rest.strip()):
        file = rest.strip()
    elif kind == "not run" and rest.strip():
        reason = rest.strip()
    elif match := re.fullmatch(r"test(?:: serve (\S+))?( with peers)?( with ray)?", mark):
        server, peers, ray = match[1], match[2] is not None, match[3] is not None
    else:
        raise ValueError(
            f"line {above[0][0]}: {mark!r}, want 'test', 'test: serve POLICY' ('with peers', 'with "
            "ray'), 'file: NAME' or 'not run: REASON'"
        )
    if language == "console":  # what begins with a prompt was typed, the rest is output
        code = [(number, line[2:]) for number, line in code if line.startswith("$ ")]
    kept = dict([*setup, *code])
    first = code[0][0] if code else above[0][0] if above else 0
    source = "\n".join(kept.get(number, "") for number in range(1, max(kept, default=0) + 1))
    return Block(language, first, source, server, reason, peers, ray, file)


def checkout(folder: Path) -> None:
    """Copy the folders of a checkout that pages name into `folder`. Evaluations of the examples get
    two episodes of each environment, and one worker.
    """
    for name in ("cluster", "deployments", "examples"):
        shutil.copytree(ROOT / name, folder / name)
    for file in (folder / "examples" / "evaluations").glob("*.yaml"):
        short = re.sub(r"\bepisodes: \d+", "episodes: 2", file.read_text())
        file.write_text(re.sub(r"\bworkers: \d+", "workers: 1", short))


def run(block: Block, cwd: Path, host: str = DOCUMENTED_HOST, *, page: str = "README") -> None:
    """Run the block in `cwd`; a failure shows the page's own line numbers."""
    source = block.source.replace(DOCUMENTED_HOST, host) + "\n"
    if block.server:
        source = source.replace(ON_THIS_MACHINE, host)
    if block.file is not None:
        (cwd / block.file).write_text(source.lstrip())
        return
    # not onnx.py, which would hide the package
    script = cwd / f"{page}_page.{'py' if block.language in PYTHON else 'sh'}"
    env = ENV | {"PATH": f"{_BIN}{os.pathsep}{ENV['PATH']}", "HOME": str(cwd)}
    script.write_text(source)
    python = str(peers_python()) if block.peers else sys.executable
    command = (
        [python, str(script)]
        if block.language in PYTHON
        else ["bash", "-eu", "-o", "pipefail", script]
    )
    done = subprocess.run(
        command,
        check=False,
        cwd=cwd,
        env=env,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=RUN_S,
    )
    assert done.returncode == 0, (
        f"{page} {block}: exit status {done.returncode}\n{done.stdout}\n{done.stderr}"
    )
    missing = not_printed(block.output, done.stdout)
    assert missing is None, f"{page} {block} does not print {missing!r}:\n{done.stdout}"


def not_printed(shown: str, printed: str) -> str | None:
    """Return the first line of `shown` that `printed` does not have after the lines before it.

    Spaces are not compared, and of numbers only their places: a page shows one run, and another has
    other times.
    """
    remaining = iter(_without_numbers(printed))
    for line in _without_numbers(shown):
        pattern = re.escape(line).replace("…", ".*")
        if not any(re.fullmatch(pattern, candidate) for candidate in remaining):
            return line
    return None


def _without_numbers(text: str) -> list[str]:
    """Return the lines of a text that are not empty, with 0 for each number, and the singular of a
    noun behind it.
    """
    lines = [re.sub("─+", "─", " ".join(line.split())) for line in text.splitlines()]
    without = [re.sub(r"\d[\d.,]*(e[-+]\d+)?", "0", line) for line in lines if line]
    return [re.sub(r"\b0 ([a-z]+)s\b", r"0 \1", line) for line in without]


def check_commands(block: Block) -> None:
    """Every command of a shell block that is not run is there, and takes the options that are
    shown.
    """
    parsed = subprocess.run(
        ["bash", "-n"], input=block.source, check=False, capture_output=True, text=True
    )
    assert parsed.returncode == 0, f"README {block}: {parsed.stderr}"
    for line in block.source.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        while words and re.match(r"\w+=", words[0]):
            words.pop(0)  # FOO=bar command
        if words:
            check_command(words, f"README {block}: {line.strip()}")


def check_command(words: list[str], where: str) -> None:
    name, *arguments = words
    if name == "make":
        command = ["make", "-C", str(ROOT), "--dry-run", *arguments]
    elif name == "vlagents-ray":
        command = [name, *arguments[: 2 if arguments[:2] == ["robot", "check"] else 1], "--help"]
    else:
        command = ["bash", "-c", f"type {shlex.quote(name)}"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=ENV, timeout=60)
    # A command of commands, as `bench` is.
    if name == "vlagents-ray" and re.search(r"Usage:.*COMMAND", done.stdout):
        command = [name, *arguments[:2], "--help"]
        done = subprocess.run(
            command, check=False, capture_output=True, text=True, env=ENV, timeout=60
        )
    assert done.returncode == 0, f"{where}\n{done.stdout}{done.stderr}"
    if name == "vlagents-ray":
        known = set(re.findall(r"--[\w-]+", done.stdout))
        shown = {word.partition("=")[0] for word in arguments if word.startswith("--")}
        assert shown - known == set(), (
            f"{where}: {sorted(shown - known)} are not among {sorted(known)}"
        )


DOCS = ROOT / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
COMMAND: Any = get_command(app)  # command of click, or of what typer has of it
PAGES = sorted([ROOT / "README.md", ROOT / "SECURITY.md", *DOCS.rglob("*.md")])


def commands(text: str) -> list[tuple[str, bool]]:
    """The commands of `vlagents-ray` in a page, and whether one stands in a block, whole, and
    not in a sentence.
    """
    blocks = re.findall(r"```(?:bash|sh|console)\n(.*?)```", text, re.DOTALL)
    lines = [
        line.strip().removeprefix("$ ")
        for block in blocks
        for line in block.replace("\\\n", " ").splitlines()
    ]
    typed = [line for line in lines if re.match(r"(\w+=\S+ )*vlagents-ray ", line)]
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    mentioned = [" ".join(one.split()) for one in re.findall(r"`(vlagents-ray [^`]*)`", prose)]
    return [(line, True) for line in typed] + [(line, False) for line in mentioned]


def options_of(line: str) -> set[str]:
    """The options of the command that a line begins with, and of those below it."""
    words = line.split()
    words = words[words.index("vlagents-ray") + 1 :]
    if words[:1] == ["robot"]:
        parsers = [robot.command_parser()[0], check_parser()]
        return {
            option
            for parser in parsers
            for action in parser._actions
            for option in action.option_strings
        }
    command = COMMAND
    while words and words[0] in getattr(command, "commands", {}):
        command = command.commands[words.pop(0)]
    below = [command, *getattr(command, "commands", {}).values()]
    return {option for one in below for parameter in one.params for option in parameter.opts}


def read_as_typed(line: str, *, whole: bool) -> None:
    """Raise what the command would say of its words before it does anything; of a mention some
    may be left out.
    """
    if not whole:
        line = re.sub(r"[\[\]…]", "", line)  # what is optional, and what is anything
    words = re.split(r" (?:\d?>|\||&)", line)[0]  # what the shell reads
    arguments = shlex.split(words, comments=True)
    arguments = arguments[arguments.index("vlagents-ray") + 1 :]
    command = COMMAND
    try:
        while hasattr(command, "resolve_command") and arguments:
            _, command, arguments = command.resolve_command(
                command.context_class(command), arguments
            )
        command.make_context(line, arguments)
    except Exception as error:
        left_out = type(error).__name__ in (
            "MissingParameter",
            "NoArgsIsHelpError",
        ) or "requires an argument" in str(error)
        if whole or not left_out:
            raise ValueError(
                f"{line}: {getattr(error, 'format_message', error.__str__)()}"
            ) from error


EXAMPLES = ROOT / "examples"


def code_of(notebook: Path, server: str | None = None) -> Block:
    """The cells of a notebook in their order, as one block of Python; raises `ValueError` if it
    has outputs.
    """
    cells = [
        cell for cell in json.loads(notebook.read_text())["cells"] if cell["cell_type"] == "code"
    ]
    if kept := [cell["id"] for cell in cells if cell["outputs"] or cell["execution_count"]]:
        raise ValueError(f"{notebook.name}: got outputs in {kept}, want none; clear them")
    code = "\n".join("".join(cell["source"]) for cell in cells).replace(
        "localhost:8000", DOCUMENTED_HOST
    )
    return Block("python", 1, code, server)
