"""What a killed driver leaves is cleaned up; of what an orderly one leaves, its HAProxy."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from eval_fakes import wait_for

from vlagents_ray.serve.reaper import about, marked

DRIVER = """
import os, subprocess, sys, time
from pathlib import Path
from vlagents_ray.serve.reaper import MARK, reaped
folder = sys.argv[1]
with reaped(Path(folder)):
    child = subprocess.Popen(["sleep", "100"], env=os.environ | {MARK: folder}, start_new_session=True)
    proxy = subprocess.Popen(
        [sys.executable, "-c", "import time; time.sleep(100)", folder + "/haproxy.cfg"],
        env=os.environ | {MARK: folder},
        start_new_session=True,
    )
    print(child.pid, proxy.pid, flush=True)
    if sys.argv[2] == "killed":
        time.sleep(100)
"""


@pytest.mark.parametrize("end", ["killed", "orderly"])
def test_only_a_killed_driver_takes_its_cluster_along(tmp_path: Path, end: str) -> None:
    folder = tmp_path / "cluster"
    folder.mkdir()
    with subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(folder), end], stdout=subprocess.PIPE, text=True
    ) as driver:
        assert driver.stdout is not None
        child, proxy = map(int, driver.stdout.readline().split())
        wait_for(lambda: about(str(folder)) == [proxy])
        assert set(marked(str(folder))) == {child, proxy}
        if end == "killed":
            driver.send_signal(signal.SIGKILL)
        driver.wait(30)
    if end == "orderly":
        assert marked(str(folder)) == [child]
        assert folder.exists()
        os.kill(child, signal.SIGKILL)
        return
    wait_for(lambda: not marked(str(folder)) and not folder.exists())
