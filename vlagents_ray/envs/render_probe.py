"""A probe that finds out whether this machine can render.

It renders one frame in a child process with a time-out, because a broken driver may hang or crash the process that
loads it. The result is cached for the life of the process.

    probe = render_probe()                  # Vulkan, as SAPIEN (ManiSkill 3) uses it
    probe.ok, probe.device, probe.cure      # True, "llvmpipe (LLVM 15.0.6, 256 bits)", None
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import vlagents_ray
from vlagents_ray.envs import graphics
from vlagents_ray.envs.graphics import EglDevice
from vlagents_ray.errors import EnvFailed, VLAgentsError

TIMEOUT_S = 60.0  # a software driver compiles its shaders in 3 to 10 s

VULKAN_CURE = (
    "install a Vulkan driver: Mesa 25 renders in software (Debian 12: apt-get install -t bookworm-backports "
    "mesa-vulkan-drivers, its own 22.3 is too old; elsewhere: mesa-vulkan-drivers); for an unpacked one set "
    "VK_ICD_FILENAMES to its lvp_icd.json"
)
VULKAN_CURE_NVIDIA = (
    "an NVIDIA driver is here but no Vulkan device: install the driver's graphics part (libnvidia-gl), or start the "
    "container with NVIDIA_DRIVER_CAPABILITIES=all"
)
EGL_CURE = (
    "install EGL: apt-get install libegl1 libgl1-mesa-dri renders in software; on NVIDIA the driver's graphics part "
    "(libnvidia-gl), in a container NVIDIA_DRIVER_CAPABILITIES=all; MUJOCO_GL must be set before mujoco is imported"
)

_BOX_XML = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="front" pos="0 -3 0" xyaxes="1 0 0 0 0 1"/>
    <geom type="box" size="0.5 0.5 0.5" rgba="1 0 0 1"/>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True, slots=True)
class RenderProbe:
    """The outcome of rendering one frame."""

    api: Literal["vulkan", "egl"]
    ok: bool
    seconds: float  # the child's run time, imports included
    device: str | None = None  # the driver's name of the device; "llvmpipe ..." is Mesa's software driver
    error: str | None = None
    cure: str | None = None
    devices: tuple[EglDevice, ...] = ()  # all devices of EGL, if EGL was tried


@functools.cache
def render_probe(timeout_s: float = TIMEOUT_S) -> RenderProbe:
    """Render one frame with SAPIEN, which needs a Vulkan device."""
    return _probed("vulkan", "sapien", "maniskill", vulkan_cure(), timeout_s)


@functools.cache
def egl_probe(timeout_s: float = TIMEOUT_S) -> RenderProbe:
    """Render one frame with MuJoCo through EGL, i.e. without a display."""
    return _probed("egl", "mujoco", "metaworld", EGL_CURE, timeout_s)


def without(modules: Sequence[str], cure: str) -> str | None:
    """Return which of these modules are not installed, with the cure; None if all are."""
    missing = next((module for module in modules if importlib.util.find_spec(module) is None), None)
    return None if missing is None else f"{missing} is not installed; {cure}"


@contextlib.contextmanager
def failing(env: str, doing: str) -> Iterator[None]:
    """Turn errors of a simulator into `EnvFailed`, with the cure of its driver; this package's own pass unchanged."""
    try:
        yield
    except VLAgentsError:
        raise
    except Exception as error:
        cure = ""
        if any(word in str(error) for word in ("EGL", "OpenGL", "GLContext", "mjr_makeContext")):
            cure = f"; {EGL_CURE}"
        elif any(word in str(error) for word in ("vk::", "rendering device", "Vulkan")):
            cure = f"; {vulkan_cure()}"
        raise EnvFailed(f"{env} failed to {doing}: {type(error).__name__}: {error}{cure}") from error


def vulkan_cure() -> str:
    """Return the cure for this machine if SAPIEN finds no rendering device."""
    nvidia = Path("/dev/nvidiactl").exists() or shutil.which("nvidia-smi") is not None
    return VULKAN_CURE_NVIDIA if nvidia else VULKAN_CURE


def vulkan_device(*, on_gpu: bool) -> tuple[str, int | None] | None:
    """Return the name and CUDA number of the device on which SAPIEN renders in this process; see `usable_devices`."""
    import sapien.render

    usable = usable_devices(sapien.render.get_device_summary())
    usable.sort(key=lambda device: (device[1] is not None) != on_gpu)  # a stable sort keeps SAPIEN's order otherwise
    return usable[0] if usable else None


def usable_devices(summary: str) -> list[tuple[str, int | None]]:
    """List the devices that SAPIEN's `summary` calls supported, in its order.

    Returns:
        For each device its name, such as "llvmpipe (LLVM 15.0.6, 256 bits)", and its number among the CUDA devices of
        this process; None if CUDA does not know it.
    """
    found = []
    for block in summary.split("GPU:")[1:]:
        name, *lines = block.splitlines()
        facts = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
        if facts.get("Supported") == "1":
            cuda = int(facts.get("cudaId", "-1"))
            found.append((name.strip(), cuda if cuda >= 0 else None))
    return found


def _probed(api: Literal["vulkan", "egl"], module: str, extra: str, cure: str, timeout_s: float) -> RenderProbe:
    """Render one frame in a child process with `module`, which the extra `extra` installs."""
    if importlib.util.find_spec(module) is None:
        error, cure = f"{module} is not installed", f"pip install 'vlagents-ray[{extra}]'"
        return RenderProbe(api, ok=False, seconds=0.0, error=error, cure=cure)
    root = str(Path(vlagents_ray.__file__).parents[1])
    path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
    variables = {**os.environ, "PYTHONPATH": path}
    if api == "egl":
        variables["MUJOCO_GL"] = "egl"
    started = time.monotonic()
    try:
        child = subprocess.run(  # noqa: S603 - our own interpreter and module, no outside input
            [sys.executable, "-m", __name__, api],
            env=variables,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        error = f"no frame within {timeout_s:g} s"
        return RenderProbe(api, ok=False, seconds=time.monotonic() - started, error=error, cure=cure)
    seconds = time.monotonic() - started
    if child.returncode == 0:
        answer = json.loads(child.stdout.splitlines()[-1])
        devices = tuple(EglDevice(**one) for one in answer["devices"])
        return RenderProbe(api, ok=True, seconds=seconds, device=answer["device"], devices=devices)
    errors = [line for line in child.stderr.splitlines() if line.strip()]
    ended = f"the child ended with {child.returncode}"
    return RenderProbe(api, ok=False, seconds=seconds, error=errors[-1].strip() if errors else ended, cure=cure)


def _render_vulkan() -> str | None:
    import numpy as np
    import sapien

    try:
        device = sapien.Device("cuda")
    except RuntimeError:
        device = sapien.Device("cpu")  # any Vulkan device, software included
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(device)])
    scene.set_ambient_light([1.0, 1.0, 1.0])
    box = scene.create_actor_builder()
    box.add_box_visual(half_size=[0.5, 0.5, 0.5], material=[1.0, 0.0, 0.0])
    box.build_kinematic(name="box")
    camera = scene.add_camera("front", width=64, height=64, fovy=1.0, near=0.01, far=10.0)
    camera.set_local_pose(sapien.Pose([-3.0, 0.0, 0.0]))
    scene.update_render()
    camera.take_picture()
    _require_contrast(np.asarray(camera.get_picture("Color"))[..., :3])
    found = vulkan_device(on_gpu=device.is_cuda())
    return None if found is None else found[0]


def _render_egl() -> str | None:
    import mujoco
    import numpy as np
    from OpenGL.GL import GL_RENDERER, glGetString

    model = mujoco.MjModel.from_xml_string(_BOX_XML)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = mujoco.Renderer(model, 64, 64)
    try:
        renderer.update_scene(data, camera="front")
        _require_contrast(np.asarray(renderer.render()))
        name = glGetString(GL_RENDERER)
    finally:
        renderer.close()
    return name.decode() if isinstance(name, bytes) else None


def _require_contrast(image: object) -> None:
    import numpy as np

    if np.ptp(np.asarray(image)) == 0:
        raise RuntimeError("the frame is of one colour: the driver runs but draws nothing")


def _main(api: str) -> None:
    device = _render_vulkan() if api == "vulkan" else _render_egl()
    devices = [asdict(one) for one in graphics.devices()] if api == "egl" else []
    sys.stdout.write("\n" + json.dumps({"device": device, "devices": devices}) + "\n")


if __name__ == "__main__":
    _main(sys.argv[1])
