"""The reaper cleans up the remains of a killed driver, and after an orderly exit the remaining
HAProxy.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from eval_fakes import wait_for

from vlagents_ray.ray_tools import reaper
from vlagents_ray.ray_tools.reaper import about, marked

DRIVER = """
import os, subprocess, sys
from pathlib import Path
from vlagents_ray.ray_tools.reaper import MARK, reaped
folder = sys.argv[1]
with reaped(Path(folder), lost=ConnectionError):
    child = subprocess.Popen(["sleep", "100"], env=os.environ | {MARK: folder}, start_new_session=True)
    proxy = subprocess.Popen(
        [sys.executable, "-c", "import time; time.sleep(100)", folder + "/haproxy.cfg"],
        env=os.environ | {MARK: folder},
        start_new_session=True,
    )
    with open(folder + "/agent.log", "w") as log:  # whose title overwrote its environment
        agent = subprocess.Popen(
            ["ray::Agent", "-c", "import time; time.sleep(100)"],
            executable=sys.executable,
            stdout=log,
            start_new_session=True,
        )
    print(child.pid, proxy.pid, agent.pid, flush=True)
    sys.stdin.readline()
    if sys.argv[2] == "without Ray":
        raise ConnectionError("the raylet has ended")
"""


@pytest.mark.slow
def test_the_reaper_needs_no_package_that_only_its_driver_finds(tmp_path: Path) -> None:
    # -S hides site-packages, even where the package is installed, as in an environment that finds
    # it through PYTHONPATH
    command = [sys.executable, "-I", "-S", reaper.__file__, str(tmp_path / "cluster")]
    ran = subprocess.run(command, check=False, input="", capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stderr) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize("end", ["killed", "without Ray", "orderly"])
def test_a_driver_that_was_killed_or_has_lost_ray_takes_its_cluster_along(
    tmp_path: Path, end: str
) -> None:
    folder = tmp_path / "cluster"
    folder.mkdir()
    with subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(folder), end],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as driver:
        assert driver.stdin is not None
        child, proxy, agent = map(int, driver.stdout.readline().split())
        wait_for(lambda: set(about(str(folder))) == {proxy, agent})
        wait_for(lambda: set(marked(str(folder))) == {child, proxy, agent})
        if end == "killed":
            driver.send_signal(signal.SIGKILL)
        else:
            driver.stdin.write("\n")
            driver.stdin.flush()
        driver.wait(30)
    if end == "orderly":
        assert marked(str(folder)) == [child]
        assert folder.exists()
        os.kill(child, signal.SIGKILL)
        return
    wait_for(lambda: not marked(str(folder)) and not folder.exists())
