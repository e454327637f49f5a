"""How a server in a job says that it can be reached."""

from __future__ import annotations

import json
import socket
import subprocess
from pathlib import Path

from vlagents_ray.slurm.job import as_text, connection_info, write

ENVIRONMENT = {
    "SLURM_JOB_ID": "12",
    "SLURM_SUBMIT_HOST": "login1",
    "SLURM_JOB_USER": "me",
    "VLAGENTS_RAY_HEAD": "10.0.0.5",
    "VLAGENTS_RAY_API_KEY": "vlr_x",
}


def test_the_connection_information_has_all_that_a_client_needs() -> None:
    host = socket.gethostname()
    found = connection_info({"pi0": "/pi0", "noop": "/"}, 9000, ENVIRONMENT)
    assert found["apps"] == {"pi0": f"http://{host}:9000/pi0", "noop": f"http://{host}:9000"}
    assert (found["job"], found["key"], found["address"]) == (12, "vlr_x", "10.0.0.5")
    assert found["ssh"] == f"ssh -N -L 9000:{host}:9000 me@login1"


def test_people_are_told_the_same() -> None:
    found = connection_info({"pi0": "/pi0"}, 9000, ENVIRONMENT)
    text = as_text(found, Path("server.json"))
    assert all(part in text for part in (found["apps"]["pi0"], found["ssh"], "server.json"))
    assert "the key that you were given" in as_text(found | {"key": None}, Path("server.json"))


def test_the_log_has_no_key_but_the_command_that_reads_it(tmp_path: Path) -> None:
    found = connection_info({"pi0": "/pi0"}, 9000, ENVIRONMENT)
    file = tmp_path / 'it\'s "here"' / "server.json"
    file.parent.mkdir()
    write(file, found)
    text = as_text(found, file)
    assert "vlr_x" not in text
    (command,) = (line.strip() for line in text.splitlines() if "export" in line)
    shown = subprocess.run(
        ["bash", "-c", f"{command}; echo $VLAGENTS_RAY_API_KEY"], check=True, capture_output=True, text=True
    )
    assert shown.stdout.strip() == "vlr_x"


def test_the_file_with_the_key_is_its_owners_alone(tmp_path: Path) -> None:
    write(tmp_path / "server.json", {"key": "vlr_x"})
    assert (tmp_path / "server.json").stat().st_mode & 0o777 == 0o600
    assert json.loads((tmp_path / "server.json").read_text()) == {"key": "vlr_x"}
