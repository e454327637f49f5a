"""Prints how to reach a job's policy server when it is ready.

python -m vlagents_ray.slurm.announce FOLDER PORT NAME=ROUTE...
"""

from __future__ import annotations

import json
import os
import shlex
import socket
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.client.credentials import KEY_VARIABLE
from vlagents_ray.slurm.allocation import HEAD

FILE = "server.json"
_POLL_S = 0.5
_MOST_S = 3600.0  # limit for loading the policies

_TEXT = """\
serving {names} in job {job}, until it ends; all of this, and the key, is in {file}
on the cluster's network:   {url}
from elsewhere, first:      {ssh}
                            and use http://localhost:{port} in its place

    {key}

    from vlagents_ray import Obs, RemoteAgent
    with RemoteAgent("{url}") as agent:
        agent.reset(obs, "pick up the cube")   # obs = Obs(cameras=..., state=...)
        print(agent.act(obs).action)
"""


def main() -> None:
    """Wait until each application is ready, write the file, and print it to the job's log."""
    folder, port, apps = Path(sys.argv[1]), int(sys.argv[2]), dict(one.split("=", 1) for one in sys.argv[3:])
    deadline = time.monotonic() + _MOST_S
    server = os.getppid()
    while not all(_answers(f"http://127.0.0.1:{port}{route.rstrip('/')}/healthz") for route in apps.values()):
        if time.monotonic() > deadline or os.getppid() != server:  # the server has ended, and its log says why
            return
        time.sleep(_POLL_S)
    found = connection_info(apps, port, os.environ)
    write(folder / FILE, found)
    sys.stdout.write(as_text(found, folder / FILE))
    sys.stdout.flush()


def connection_info(apps: Mapping[str, str], port: int, environ: Mapping[str, str]) -> dict[str, Any]:
    """Return what a client needs to connect.

    Args:
        apps: The applications and their routes.
        port: The server's port.
        environ: The environment of the job.

    Returns:
        The content of the file, with the URL of each application, the key, and a command for a tunnel.
    """
    host = socket.gethostname()
    url = f"http://{host}:{port}"
    login = environ.get("SLURM_SUBMIT_HOST", host)
    user = environ.get("SLURM_JOB_USER", environ.get("USER", ""))
    return {
        "job": int(environ["SLURM_JOB_ID"]),
        "host": host,
        "address": environ[HEAD],
        "port": port,
        "url": url,
        "apps": {name: url + route.rstrip("/") for name, route in apps.items()},
        "key": environ.get(KEY_VARIABLE) or None,
        "ssh": f"ssh -N -L {port}:{host}:{port} {user}@{login}",
    }


def as_text(found: Mapping[str, Any], file: Path) -> str:
    """Return the connection's information as text for people, without the key: logs are read by others."""
    url = next(iter(found["apps"].values()))
    key = f"export {KEY_VARIABLE}=(the key that you were given; none, if the server is --insecure)"
    if found["key"]:
        read = "import json, sys; print(json.load(open(sys.argv[1]))['key'])"
        key = f'export {KEY_VARIABLE}=$(python3 -c "{read}" {shlex.quote(str(file))})'
    names = ", ".join(found["apps"])
    return _TEXT.format(**{**found, "url": url, "key": key, "names": names, "file": file})


def write(file: Path, found: Mapping[str, Any]) -> None:
    """Write the file, which contains a key, atomically and readable by its owner only."""
    part = file.with_suffix(".part")
    part.touch(mode=0o600)
    part.write_text(json.dumps(found, indent=2) + "\n")
    part.replace(file)


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=5):  # noqa: S310 - our own server
            return True
    except (urllib.error.URLError, OSError):
        return False


if __name__ == "__main__":
    main()
