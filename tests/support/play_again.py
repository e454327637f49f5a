"""Run pytest with the given arguments, and run a few failed tests once more, alone. `.ci/run` uses
this script.

A test that passes the second time is flaky. It is listed, so that its cause can be fixed, but the
run does not fail. Without the variable `CI`, a failed test fails at once.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

_MOST = 10  # number of files; more failures have a cause that a second run does not change


def main(arguments: list[str]) -> int:
    """Run pytest with `arguments`.

    Returns:
        The exit status of pytest, or of the second run if there was one.
    """
    with tempfile.TemporaryDirectory() as cache:
        command = [sys.executable, "-m", "pytest", "-o", f"cache_dir={cache}"]
        status = subprocess.run([*command, *arguments], check=False).returncode
        failed_tests = Path(cache) / "v" / "cache" / "lastfailed"
        failed = sorted(json.loads(failed_tests.read_text())) if failed_tests.exists() else []
        if status != 1 or not failed or os.environ.get("CI") != "true":
            return status
        # A server that did not start makes all tests of a file fail.
        if len({name.partition("::")[0] for name in failed}) > _MOST:
            return status
        print(
            f"== {len(failed)} tests failed; running them once more, alone",
            *failed,
            sep="\n  ",
            flush=True,
        )
        again = subprocess.run([*command, *failed], check=False).returncode
        still_failed = set(json.loads(failed_tests.read_text())) if failed_tests.exists() else set()
        for name in sorted(set(failed) - still_failed):
            print(
                f"flaky: {name} failed among other tests and passed alone; fix its cause",
                flush=True,
            )
        return again


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
