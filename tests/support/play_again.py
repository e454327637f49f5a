"""Run pytest with the given arguments, and play a few failed tests once more, alone: `.ci/run` does
so.

A test that passes the second time fails by chance. It is listed as flaky, so that its cause is
mended, and does not make the run fail. Everywhere else (`CI` is not set) a failed test fails at
once.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

_MOST = 10  # files; failures in more have a cause that a second try does not change


def main(arguments: list[str]) -> int:
    """Run pytest with `arguments`.

    Returns:
        The exit status of pytest, or of the second run where there was one.
    """
    with tempfile.TemporaryDirectory() as cache:
        command = [sys.executable, "-m", "pytest", "-o", f"cache_dir={cache}"]
        status = subprocess.run([*command, *arguments], check=False).returncode
        failed_tests = Path(cache) / "v" / "cache" / "lastfailed"
        failed = sorted(json.loads(failed_tests.read_text())) if failed_tests.exists() else []
        if status != 1 or not failed or os.environ.get("CI") != "true":
            return status
        # A server that did not start fails a whole file.
        if len({name.partition("::")[0] for name in failed}) > _MOST:
            return status
        print(f"== {len(failed)} failed; once more, alone", *failed, sep="\n  ", flush=True)
        again = subprocess.run([*command, *failed], check=False).returncode
        still_failed = set(json.loads(failed_tests.read_text())) if failed_tests.exists() else set()
        for name in sorted(set(failed) - still_failed):
            print(
                f"flaky: {name} failed beside others and passed alone; mend its cause", flush=True
            )
        return again


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
