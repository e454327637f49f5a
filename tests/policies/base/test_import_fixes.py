"""The changes to torchvision and LeRobot in environments that `venv create` makes, tested with
small packages.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from vlagents_ray.policies.base import import_fixes

TORCH = """
from types import SimpleNamespace
version = SimpleNamespace(cuda={cuda!r}, hip=None)
defined = []
class Library:
    def __init__(self, *names): pass
    def define(self, schema): defined.append("torchvision::" + schema.partition("(")[0])
library = SimpleNamespace(Library=Library)
"""
# A package like torchvision: one submodule that loads, and one that looks up an operator.
TORCHVISION = """
from torchvision import io
import torch
if "torchvision::nms" not in torch.defined:
    raise RuntimeError("operator torchvision::nms does not exist")
ready = True
"""
FITS = "from torchvision import io\nready = True\n"
VIDEO_UTILS = """
import torchvision
def get_safe_default_codec(): return "torchcodec"
def decode_video_frames_torchvision(): return "LeRobot's"
"""
USED = """
from lerobot.datasets.video_utils import decode_video_frames_torchvision as decode, get_safe_default_codec as codec
import torch, torchvision
print(torchvision.ready, torch.defined, codec(), decode.__name__)
"""


class Packages:
    """A folder of importable packages, with the fixes as `venv create` installs them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.write("fixes", Path(import_fixes.__file__).read_text())

    def write(self, module: str, text: str) -> None:
        path = self.folder.joinpath(*module.split("."))
        path.mkdir(parents=True, exist_ok=True)
        (path / "__init__.py").write_text(text)

    def run(self, code: str) -> tuple[str, str]:
        """Return the output of the code after the fixes were installed, and its last line on
        stderr.
        """
        done = subprocess.run(
            [sys.executable, "-S", "-c", f"import fixes; fixes.install(); fixes.install()\n{code}"],
            env={"PYTHONPATH": str(self.folder)},
            capture_output=True,
            text=True,
            check=False,
        )
        return done.stdout.strip(), done.stderr.strip().rpartition("\n")[2]


@pytest.fixture
def packages(tmp_path: Path) -> Packages:
    """Return the packages of a laptop: a torch without CUDA, a torchvision with CUDA and without a
    video reader, and no torchcodec.
    """
    made = Packages(tmp_path)
    made.write("torch", TORCH.format(cuda=None))
    made.write("torchvision", TORCHVISION)
    made.write("torchvision.io", "")
    made.write("lerobot", "")
    made.write("lerobot.datasets", "")
    made.write("lerobot.datasets.video_utils", VIDEO_UTILS)
    return made


def test_a_torchvision_of_another_build_is_imported_and_videos_are_read_with_pyav(
    packages: Packages,
) -> None:
    said, _ = packages.run(USED)
    assert said == "True ['torchvision::nms', 'torchvision::qnms'] pyav decode_frames"


def test_where_all_fits_nothing_is_changed(packages: Packages) -> None:
    packages.write("torch", TORCH.format(cuda="13.0"))
    packages.write("torchvision", FITS)
    packages.write("torchvision.io", "class VideoReader: pass\n")
    packages.write("torchcodec", "")
    packages.write("torchcodec.decoders", "")
    assert packages.run(USED)[0] == "True [] torchcodec decode_video_frames_torchvision"


def test_a_torchcodec_that_finds_no_ffmpeg_is_left_out_and_that_is_said(packages: Packages) -> None:
    packages.write("torchvision", FITS)
    packages.write("torchvision.io", "class VideoReader: pass\n")
    packages.write("torchcodec", "")
    packages.write(
        "torchcodec.decoders",
        "raise RuntimeError('Could not load libtorchcodec.\\nMany lines follow.')\n",
    )
    said, warned = packages.run(USED)
    assert said == "True [] pyav decode_video_frames_torchvision"
    assert (
        warned
        == "torchcodec does not load (Could not load libtorchcodec.); videos are read with PyAV"
    )


def test_with_cuda_a_torchvision_that_does_not_fit_stays_an_error(packages: Packages) -> None:
    packages.write("torch", TORCH.format(cuda="13.0"))
    assert (
        packages.run("import torchvision")[1]
        == "RuntimeError: operator torchvision::nms does not exist"
    )


def test_other_errors_of_torchvision_stay_as_they_are(packages: Packages) -> None:
    packages.write("torchvision", "raise RuntimeError('out of memory')")
    assert packages.run("import torchvision")[1] == "RuntimeError: out of memory"


def test_without_torchvision_and_lerobot_nothing_is_imported(packages: Packages) -> None:
    said, _ = packages.run(
        "import sys; print(sorted({'torch', 'torchvision', 'numpy', 'av'} & set(sys.modules)))"
    )
    assert said == "[]"
