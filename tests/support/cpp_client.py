"""The C++ client in a separate process, whose calls a test controls."""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Any

CLIENT = Path(__file__).parents[2] / "clients" / "cpp"
_NEEDED = (
    "#if !__has_include(<nlohmann/json.hpp>) || !__has_include(<jpeglib.h>)\n#error "
    "missing\n#endif\n"
)
_BUILD_S = 300
_ANSWER_S = 60


@functools.cache
def no_compiler() -> str | None:
    """Return why the client cannot be built here; None if it can."""
    if shutil.which("cmake") is None or shutil.which("c++") is None:
        return "no CMake, or no C++ compiler"
    found = subprocess.run(
        ["c++", "-std=c++17", *_includes(), "-fsyntax-only", "-x", "c++", "-"],
        input=_NEEDED, text=True, capture_output=True, check=False,
    )  # fmt: skip
    return (
        None
        if found.returncode == 0
        else "no nlohmann/json.hpp, or no jpeglib.h (Debian: nlohmann-json3-dev, libjpeg-dev)"
    )


def _includes() -> list[str]:
    """Return the include options of all folders in which CMake looks for packages."""
    prefixes = os.environ.get("CMAKE_PREFIX_PATH", "").split(os.pathsep)
    return [f"-I{prefix}/include" for prefix in prefixes if prefix]


def build(folder: Path) -> Path:
    """Install the client in `folder`, and build its test programs as a user's project would; return
    the folder of the programs.
    """
    installed, programs = folder / "installed", folder / "programs"
    prefixes = os.pathsep.join(
        filter(None, [str(installed), os.environ.get("CMAKE_PREFIX_PATH", "")])
    )
    for command in (
        ["cmake", "-S", CLIENT, "-B", folder / "client", "-DVLAGENTS_RAY_EXAMPLES=OFF"],
        ["cmake", "--install", folder / "client", "--prefix", installed],
        ["cmake", "-S", CLIENT / "tests", "-B", programs, *_sanitized()],
        ["cmake", "--build", programs, "--parallel", "2"],
    ):
        done = subprocess.run(
            command,
            env=os.environ | {"CMAKE_PREFIX_PATH": prefixes},
            capture_output=True,
            text=True,
            timeout=_BUILD_S,
            check=False,
        )
        assert done.returncode == 0, f"{command}: {done.stdout[-2000:]}{done.stderr[-4000:]}"
    return programs


def _sanitized() -> list[str]:
    return ["-DSANITIZE=ON"] if os.environ.get("VLAGENTS_SANITIZE") == "1" else []


class CppError(Exception):
    """An exception that the client threw."""

    def __init__(self, code: str, detail: str, retry_after_s: float | None = None) -> None:
        super().__init__(f"{code}: {detail}")
        self.code, self.detail, self.retry_after_s = code, detail, retry_after_s


class CppClient:
    """The C++ client. Each method of its driver (clients/cpp/tests/driver.cpp) is a call with
    arguments.
    """

    def __init__(self, programs: Path, url: str = "", **options: Any) -> None:
        """Start the driver. With a `url`, also create a `Client`, and with `ahead` a `ChunkPlayer`."""
        self._process = subprocess.Popen(
            [programs / "driver"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        if url:
            self.call("connect", url=url, **options)

    def begin(self, do: str, **arguments: Any) -> None:
        """Begin a call; `result` returns its outcome."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": do, **arguments}) + "\n")
        self._process.stdin.flush()

    def result(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, self._process.communicate(timeout=_ANSWER_S)[1]
        answer = json.loads(line)
        if "error" in answer:
            raise CppError(**answer["error"])
        return answer["result"]

    def call(self, do: str, **arguments: Any) -> Any:
        self.begin(do, **arguments)
        return self.result()

    def peak_mb(self) -> float:
        """Return the peak memory of the client's process, in MB."""
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        return float(status.partition("VmHWM:")[2].split()[0]) / 1000

    def reset(self, **obs: Any) -> Any:
        return self.call("reset", obs=obs, instruction="push the cube", kwargs={"seed": 3})

    def act(self, **obs: Any) -> Any:
        return self.call("act", obs=obs)

    def __enter__(self) -> CppClient:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        # The driver ends when its input ends.
        _, said = self._process.communicate(timeout=_ANSWER_S)
        if kind is None:
            assert (self._process.returncode, said) == (0, "")
