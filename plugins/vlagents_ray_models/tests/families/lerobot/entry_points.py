"""LeRobot's commands as their console scripts start them, each in a process forked from one that
has imported them.

Importing LeRobot's commands takes ten seconds: `python entry_points.py` does it once for all lines
of its input, each a command and its options as JSON, and prints the exit status of each. A
command's output is in the file NUMBER.log. Options have no help, which draccus reads in the sources
of all types of policies and robots for three seconds. A command's terminal is one on which the
simulated robot's operator types.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import sys
import traceback
from collections.abc import Callable

from draccus.wrappers import docstring

MAINS: dict[str, Callable[[], None]] = {
    f"lerobot-{name}": importlib.import_module(f"lerobot.scripts.lerobot_{name}").main
    for name in ("eval", "record", "rollout")
    if importlib.util.find_spec(f"lerobot.scripts.lerobot_{name}") is not None
}


def status(command: list[str], log: str) -> int:
    """Run a command in a separate process, and return its exit status."""
    if child := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    keyboard, terminal = os.openpty()
    os.dup2(terminal, 0)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 - as long as the process
    os.environ["MIRROR_KEYBOARD"] = str(keyboard)
    with open(log, "w") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    sys.argv = command
    code = 1
    try:
        MAINS[command[0]]()
        code = 0
    except BaseException:  # noqa: BLE001 - printed as the interpreter does
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    docstring.get_attribute_docstring = lambda *_: docstring.AttributeDocString()
    for number, line in enumerate(sys.stdin):
        print(status(json.loads(line), f"{number}.log"), flush=True)
