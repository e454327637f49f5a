"""Mutation tests: small defects, drawn from all subjects of the core, and each run against the
subject's tests.

`python -m tests.support.mutants --seed 56 --count 60` runs them in a copy of the checkout, and
writes a line of JSON for each. A surviving mutant shows a missing test, unnecessary code, or a
change without an effect. `--list` only prints them.
"""

from __future__ import annotations

import argparse
import ast
import copy
import itertools
import json
import os
import queue
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]

# Excluded markers: mutants run only against tests that need no other resources.
MARKS = (
    "not (ray or server or hosts or sim or vulkan or gpu or browser or compiler or alone"
    " or integration)"
)
RELATED_FILES = 6  # number of test files that run first


@dataclass(frozen=True)
class Subject:
    """A part of the core, and the tests that can detect its defects, fastest first."""

    sources: tuple[str, ...]  # patterns of files
    tests: tuple[str, ...]  # folders and files


SUBJECTS = {
    "queue": Subject(
        ("vlagents_ray/serve/queue/*.py",),
        (
            "tests/serve/queue",
            "tests/serve/scaling/test_autoscaling.py",
            "tests/simulation",
            "tests/serve/engine",
            "tests/serve/endpoints",
        ),
    ),
    "sessions": Subject(
        ("vlagents_ray/serve/sessions.py", "vlagents_ray/serve/scaling/session_migration.py"),
        (
            "tests/serve/test_sessions.py",
            "tests/serve/scaling",
            "tests/serve/engine",
            "tests/serve/test_not_executed.py",
        ),
    ),
    "models": Subject(
        ("vlagents_ray/serve/models/*.py",),
        (
            "tests/serve/models",
            "tests/serve/engine",
            "tests/serve/weights",
            "tests/serve/python_env",
            "tests/serve/queue/test_call_limits.py",
            "tests/serve/test_loading.py",
        ),
    ),
    "engine": Subject(
        ("vlagents_ray/serve/engine/*.py",),
        (
            "tests/serve/engine",
            "tests/serve/test_sessions.py",
            "tests/simulation",
            "tests/serve/scaling",
            "tests/serve/weights",
            "tests/serve/endpoints",
            "tests/serve",
        ),
    ),
    "protocol": Subject(
        ("vlagents_ray/protocol/*.py",),
        (
            "tests/protocol",
            "plugins/vlagents_ray_dialects/tests/test_codecs.py",
            "tests/client",
            "tests/serve/endpoints",
        ),
    ),
    "results": Subject(("vlagents_ray/evaluate/results/*.py",), ("tests/evaluate",)),
    "guard": Subject(
        (
            "vlagents_ray/robot/guard.py",
            "vlagents_ray/robot/watchdog.py",
            "vlagents_ray/robot/limits.py",
        ),
        ("tests/robot", "plugins/vlagents_ray_robot/tests"),
    ),
    "chunking": Subject(("vlagents_ray/chunking/*.py",), ("tests/chunking", "tests/robot")),
    "weights": Subject(
        ("vlagents_ray/weights/*.py", "vlagents_ray/serve/weights.py"),
        (
            "tests/weights",
            "tests/serve/weights",
            "plugins/vlagents_ray_learn/tests",
            "tests/serve/scaling/test_moves.py",
        ),
    ),
}

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Add,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
}


@dataclass(frozen=True)
class Mutant:
    """One change of one file."""

    subject: str
    file: str
    line: int
    before: str  # the source text that is replaced
    after: str
    start: int  # byte of the file at which `before` begins

    def in_source(self, source: bytes) -> bytes:
        """Return the bytes of the file with the change applied."""
        end = self.start + len(self.before.encode())
        return source[: self.start] + self.after.encode() + source[end:]

    def __str__(self) -> str:
        before, after = (" ".join(text.split())[:90] for text in (self.before, self.after))
        return f"{self.subject}  {self.file}:{self.line}  {before}  ->  {after}"


def changed_node(node: ast.AST) -> ast.AST | None:
    """Return the node with a defect; None if this kind of node has no mutation."""
    changed = copy.deepcopy(node)
    match changed:
        case ast.Compare() if type(changed.ops[0]) in _COMPARISONS:
            changed.ops[0] = _COMPARISONS[type(changed.ops[0])]()
        case ast.BoolOp():
            changed.op = ast.And() if isinstance(changed.op, ast.Or) else ast.Or()
        case ast.BinOp() if type(changed.op) in _ARITHMETIC:
            changed.op = _ARITHMETIC[type(changed.op)]()
        case ast.UnaryOp(op=ast.Not()):
            return changed.operand
        case ast.Constant(value=bool()):
            changed.value = not changed.value
        case ast.Constant(value=int()):
            changed.value += 1
        case ast.Expr(value=ast.Call()):
            return ast.Constant(None)
        case ast.Return(value=ast.expr() as value) if not isinstance(value, ast.Constant):
            changed.value = ast.Constant(None)
        case _:
            return None
    return changed


def executed_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that a program executes, except types and error messages."""
    if isinstance(node, ast.Raise):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from executed_nodes(child)


def mutants_of(subject: str, file: Path) -> Iterator[Mutant]:
    """Yield all mutants of a file."""
    source = file.read_bytes()
    line_starts = [0, *itertools.accumulate(map(len, source.splitlines(keepends=True)))]

    for node in executed_nodes(ast.parse(source)):
        changed = changed_node(node)
        if changed is None:
            continue
        start = line_starts[node.lineno - 1] + node.col_offset
        end = line_starts[node.end_lineno - 1] + node.end_col_offset
        before = source[start:end].decode()
        if not _is_replaceable(node, before):
            continue
        after = ast.unparse(changed)
        if isinstance(node, ast.Compare | ast.BoolOp | ast.BinOp | ast.UnaryOp):
            after = f"({after})"
        yield Mutant(subject, str(file.relative_to(ROOT)), node.lineno, before, after, start)


def _is_replaceable(node: ast.AST, text: str) -> bool:
    """Return whether the text alone represents the node. Parts of an f-string are not
    replaceable.
    """
    if not isinstance(node, ast.expr):
        return True
    try:
        parsed = ast.parse(f"({text})", mode="eval").body
    except SyntaxError:
        return False
    return ast.dump(parsed) == ast.dump(node)


def draw(seed: int, count: int) -> list[Mutant]:
    """Draw `count` mutants in total, equally many of each subject, and interleave the subjects.

    The draws of a subject depend only on the seed and on the subject's sources.
    """
    turns: list[tuple[int, str, Mutant]] = []
    for name, subject in SUBJECTS.items():
        files = sorted(file for pattern in subject.sources for file in ROOT.glob(pattern))
        mutants = [mutant for file in files for mutant in mutants_of(name, file)]
        drawn = random.Random(f"{seed} {name}").sample(mutants, min(count, len(mutants)))
        turns += [(turn, name, mutant) for turn, mutant in enumerate(drawn)]
    turns.sort(key=lambda entry: entry[:2])
    return [mutant for _, _, mutant in turns[:count]]


def files_of_tests(mutant: Mutant) -> tuple[list[str], list[str]]:
    """Return the test files most related to the module of the mutant, and the remaining files of
    its subject.
    """
    files: list[Path] = []
    for place in SUBJECTS[mutant.subject].tests:
        path = ROOT / place
        files += [path] if path.is_file() else sorted(path.rglob("test_*.py"))
    module = Path(mutant.file).with_suffix("")
    import_name = ".".join(module.parts)

    def relation(file: Path) -> int:
        text = file.read_text()
        imports = import_name in text
        return 100 * (module.name in file.stem) + 50 * imports + min(text.count(module.name), 40)

    # Models of other libraries have separate environments.
    names = dict.fromkeys(
        str(file.relative_to(ROOT)) for file in files if "families" not in file.parts
    )
    ordered = sorted(names, key=lambda name: -relation(ROOT / name))
    return ordered[:RELATED_FILES], ordered[RELATED_FILES:]


def copy_checkout(folder: Path) -> None:
    """Copy the files of the checkout, including uncommitted files."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        check=True,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    for name in listed.stdout.split("\0"):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)


def play(root: Path, tests: Sequence[str], python: str, limit_s: float) -> tuple[str, str]:
    """Run tests until one fails.

    Args:
        root: The copy of the project.
        tests: Files or names of tests.
        python: The program that runs pytest.
        limit_s: Time limit of the run, in seconds.

    Returns:
        "killed", "survived" or "out of time", and the test that failed or the last line of pytest.
    """
    folders = [root, *sorted(root.glob("plugins/*"))]
    environment = {
        **os.environ,
        "PYTHONPATH": ":".join(map(str, folders)),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    options = ["-x", "-q", "--tb=line", "--timeout=60", "-p", "no:cacheprovider", "-m", MARKS]
    try:
        done = subprocess.run(
            [python, "-m", "pytest", *options, *tests],
            check=False,
            cwd=root,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=limit_s,
        )
    except subprocess.TimeoutExpired:
        return "out of time", f"no result after {limit_s:g} s"
    failures = re.findall(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", done.stdout, re.MULTILINE)
    last_line = done.stdout.strip().rpartition("\n")[2]
    if done.returncode in (0, 5):  # exit status 5: no test remains after MARKS
        return "survived", last_line
    if done.returncode in (1, 2, 4):
        return "killed", failures[0] if failures else last_line
    return "out of time", failures[0] if failures else last_line


def play_mutant(mutant: Mutant, root: Path, python: str, limit_s: float) -> dict[str, object]:
    """Run the tests of the mutant's subject against it, the most related tests first."""
    began = time.monotonic()
    changed = root / mutant.file
    source = changed.read_bytes()
    changed.write_bytes(mutant.in_source(source))
    try:
        for tests in files_of_tests(mutant):
            how, test = play(root, tests, python, limit_s)
            if how != "survived":
                break
    finally:
        changed.write_bytes(source)
    return {
        "mutant": str(mutant),
        "start": mutant.start,
        "how": how,
        "test": test,
        "s": round(time.monotonic() - began, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=56)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument(
        "--list", action="store_true", help="print the mutants without running tests"
    )
    parser.add_argument("--only", type=int, nargs="+", help="numbers of mutants, as --list prints")
    parser.add_argument(
        "--jobs", type=int, default=1, help="number of mutants that run at the same time"
    )
    parser.add_argument(
        "--limit-s", type=float, default=240.0, help="time limit of a run of pytest, in seconds"
    )
    parser.add_argument("--python", default=sys.executable, help="Python program that runs pytest")
    parser.add_argument("--out", type=Path, default=Path("mutants.jsonl"), help="results, appended")
    options = parser.parse_args()

    numbered = list(enumerate(draw(options.seed, options.count)))
    if options.only:
        numbered = [numbered[number] for number in options.only]
    if options.list:
        for number, mutant in numbered:
            print(number, mutant)
        return

    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(options.jobs) as threads:
        copies: queue.Queue[Path] = queue.Queue()
        killers: set[str] = set()
        for job in range(options.jobs):
            copy_checkout(Path(folder) / str(job))
            copies.put(Path(folder) / str(job))

        def play_numbered(entry: tuple[int, Mutant]) -> None:
            number, mutant = entry
            root = copies.get()
            row = play_mutant(mutant, root, options.python, options.limit_s)
            copies.put(root)
            if row["how"] == "killed":
                killers.add(str(row["test"]))
            with options.out.open("a") as results:
                results.write(json.dumps({"number": number, **row}) + "\n")
            print(number, row["how"], row["test"], flush=True)

        list(threads.map(play_numbered, numbered))

        how, test = play(copies.get(), sorted(killers), options.python, options.limit_s)
        if how != "survived":
            print(f"a test fails without a mutation: {test}")


if __name__ == "__main__":
    main()
