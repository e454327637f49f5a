"""Read, run and check the blocks of a Markdown text, its commands, and the files of examples/.

An HTML comment directly above a block defines its test:

- `<!-- test: serve scripted -->` runs the block with a server of that policy in place of
  http://gpu-box:8000 or http://localhost:8000.
- `<!-- test -->`, or no comment, runs it without a server.
- ` with peers` at the end of either runs it with the Python that has other systems' clients.
- ` with ray` marks a block of docs/ that starts Ray.

Further lines of such a comment are code that runs before the block:

    <!-- test: serve scripted
    obs = Obs(gripper=1.0) -->

`<!-- output -->` above a block of text means that the block before it prints these lines, in this
order and possibly among others. Numbers are not compared, and `…` matches any text.

`<!-- file: NAME -->` means that the reader saves the block, in any language, under that name. Later
blocks on the page find the file.

`<!-- not run: REASON -->` gives the reason why a block is not run. Its commands must at least
exist, and commands of `vlagents-ray` must have the shown options. Where blocks run, `sbatch` is a
stand-in that accepts every job and runs none.
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
# The environment of a reader, without PYTHONPATH. But if PYTHONPATH contains this checkout, it is
# kept, since another checkout may be installed.
_HERE = (
    {"PYTHONPATH": str(ROOT)}
    if str(ROOT) in os.environ.get("PYTHONPATH", "").split(os.pathsep)
    else {}
)
_READERS = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | _HERE
# stand-ins for commands that a reader has, but possibly not this machine
_BIN = Path(__file__).parent / "bin"
ENV = _READERS | {
    "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    "RAY_USAGE_STATS_ENABLED": "0",
    "COLUMNS": "300",  # wide enough that --help does not truncate names
    "TERM": "dumb",
}
RUN_S = 300


@dataclass(frozen=True)
class Block:
    """One fenced block. `source` has the code of the block and of its comment, at the same line
    numbers as on the page.
    """

    language: str
    line: int
    source: str
    server: str | None = None  # the policy that must be served while it runs
    not_run: str | None = None  # the reason if it is not run
    peers: bool = False  # whether it needs the Python of the peers' environment
    ray: bool = False  # whether it starts Ray
    file: str | None = None  # the name under which it is saved instead of being run
    output: str = ""  # the part of its output that the page shows

    def __str__(self) -> str:
        return f"line-{self.line}"


def blocks(text: str) -> list[Block]:
    """Return the Python and shell blocks of a Markdown text. Raise `ValueError` for an unknown mark
    or an unfinished block.
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
            f"line {above[0][0]}: expected 'test', 'test: serve POLICY' ('with peers', 'with "
            "ray'), 'file: NAME' or 'not run: REASON', got {mark!r}"
        )
    if language == "console":  # lines with a prompt are input, the remaining ones are output
        code = [(number, line[2:]) for number, line in code if line.startswith("$ ")]
    kept = dict([*setup, *code])
    first = code[0][0] if code else above[0][0] if above else 0
    source = "\n".join(kept.get(number, "") for number in range(1, max(kept, default=0) + 1))
    return Block(language, first, source, server, reason, peers, ray, file)


def checkout(folder: Path) -> None:
    """Copy the folders of a checkout that pages mention into `folder`. Evaluations of the examples
    get two episodes of each environment, and one worker.
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
    # Not onnx.py, for example, which would hide the package.
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

    Spaces and the values of numbers are not compared, since times differ between runs.
    """
    remaining = iter(_without_numbers(printed))
    for line in _without_numbers(shown):
        pattern = re.escape(line).replace("…", ".*")
        if not any(re.fullmatch(pattern, candidate) for candidate in remaining):
            return line
    return None


def _without_numbers(text: str) -> list[str]:
    """Return the lines of a text that are not empty, with 0 for each number, and with the noun
    after a number in the singular.
    """
    lines = [re.sub("─+", "─", " ".join(line.split())) for line in text.splitlines()]
    without = [re.sub(r"\d[\d.,]*(e[-+]\d+)?", "0", line) for line in lines if line]
    return [re.sub(r"\b0 ([a-z]+)s\b", r"0 \1", line) for line in without]


def check_commands(block: Block) -> None:
    """Check that each command of a shell block that is not run exists, and accepts the shown
    options.
    """
    parsed = subprocess.run(
        ["bash", "-n"], input=block.source, check=False, capture_output=True, text=True
    )
    assert parsed.returncode == 0, f"README {block}: {parsed.stderr}"
    for line in block.source.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        while words and re.match(r"\w+=", words[0]):
            words.pop(0)  # an assignment in front of the command, as in FOO=bar command
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
    # A group of commands, such as `bench`.
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
COMMAND: Any = get_command(app)  # the main command, as a click command made by typer
PAGES = sorted([ROOT / "README.md", ROOT / "SECURITY.md", *DOCS.rglob("*.md")])


def section(folder: str, page: str) -> str:
    """Return the text of a page of docs/, given as `page` or, for one section of it, as
    `page#anchor`.
    """
    name, _, anchor = page.partition("#")
    text = (DOCS / folder / f"{name}.md").read_text()
    if not anchor:
        return text
    for part in re.split(r"^(?=## )", text, flags=re.MULTILINE):
        if re.sub(r"[^\w-]", "", part.partition("\n")[0][3:].lower().replace(" ", "-")) == anchor:
            return part
    raise ValueError(f"docs/{folder}/{name}.md: got no heading of the second level for #{anchor}")


def commands(text: str) -> list[tuple[str, bool]]:
    """Return the commands of `vlagents-ray` in a page. The flag is true for a complete command in a
    block, and false for a command in a sentence.
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
    """Return the options of the command with which a line begins, and of its subcommands."""
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
    """Raise the error with which the command would reject its arguments. A command in a sentence
    may lack required arguments.
    """
    if not whole:
        line = re.sub(r"[\[\]…]", "", line)  # brackets of optional arguments, and ellipses
    words = re.split(r" (?:\d?>|\||&)", line)[0]  # without pipes and redirections of the shell
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
    """Return the cells of a notebook in order, as one block of Python; raise `ValueError` if it has
    outputs.
    """
    cells = [
        cell for cell in json.loads(notebook.read_text())["cells"] if cell["cell_type"] == "code"
    ]
    if kept := [cell["id"] for cell in cells if cell["outputs"] or cell["execution_count"]]:
        raise ValueError(f"{notebook.name}: expected no outputs, got some in {kept}; clear them")
    code = "\n".join("".join(cell["source"]) for cell in cells).replace(
        "localhost:8000", DOCUMENTED_HOST
    )
    return Block("python", 1, code, server)
