"""Tests that `vlagents-ray robot check --json` prints only one JSON document on stdout."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from vlagents_ray_robot.check_command import main

ARM = (
    "import numpy as np\n"
    "from vlagents_ray import Obs\n"
    "class Arm:\n"
    "    def observe(self): return Obs(gripper=50.0)\n"
)
ARM += "    def apply(self, action): pass\n    def stop(self): pass\n"


def test_what_a_script_reads_is_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bare_arm.py").write_text(ARM)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert main(["bare_arm:Arm", "--json", "--out", str(tmp_path / "arm.html")]) == 1
    checked = json.loads(capsys.readouterr().out)
    assert checked["ok"] is False
    assert checked["findings"][0].keys() == {"check", "got", "want", "cure", "when"}
