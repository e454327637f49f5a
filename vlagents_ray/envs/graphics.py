"""The choice of the device that renders an env's images.

Ray sets CUDA_VISIBLE_DEVICES to the GPU of a worker, but neither EGL nor Vulkan reads it. Both
would use their first device, which may be the GPU of a policy. Therefore, if CUDA_VISIBLE_DEVICES
is set, this module chooses the device, and checks that the simulator uses it.

The probes render one frame in a child process with a timeout, because a broken driver may hang or
crash the process that loads it. The results are cached for the lifetime of the process.

    probe = render_probe()                  # Vulkan, as SAPIEN (ManiSkill 3) uses it
    probe.ok, probe.device, probe.cure      # True, "llvmpipe (LLVM 15.0.6, 256 bits)", None
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import vlagents_ray
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import how_to_install

_MOST_DEVICES = 64
# Constants from the headers of EGL and OpenGL.
_EXTENSIONS = 0x3055  # query of a device: its extensions, a string
_DEVICE = 0x322C  # query of a display: its device, an attribute
_CUDA_DEVICE = 0x323A  # query of a device: its CUDA number, an attribute
_GL_RENDERER = 0x1F01  # query of a context: the name of its device, a string
_SOFTWARE = "EGL_MESA_device_software"
_CUDA = "EGL_NV_device_cuda"
_Value = ctypes.c_ssize_t  # type EGLAttrib


@dataclass(frozen=True, slots=True)
class EglDevice:
    """A device of EGL."""

    number: int  # index in EGL's order, as in MUJOCO_EGL_DEVICE_ID
    software: bool
    # Index among the CUDA devices that this process may use; None if the device is not one of
    # these.
    cuda: int | None


def devices() -> list[EglDevice]:
    """Return all devices in EGL's order; empty if EGL is missing or too old."""
    functions = _functions()
    return [] if functions is None else [device for _, device in functions.devices()]


class _Functions:
    """The functions of EGL that this module uses.

    The constructor raises `AttributeError` or `OSError` if one is missing.
    """

    def __init__(self) -> None:
        self.library = ctypes.CDLL("libEGL.so.1")
        self.library.eglGetProcAddress.restype = ctypes.c_void_p
        self.library.eglGetProcAddress.argtypes = [ctypes.c_char_p]
        self.library.eglGetCurrentDisplay.restype = ctypes.c_void_p

        # Look up each function, with the type of its result and the types of its arguments.
        pointers, integers = ctypes.POINTER(ctypes.c_void_p), ctypes.POINTER(ctypes.c_int)
        self._query = self._extension(
            "eglQueryDevicesEXT", ctypes.c_uint, ctypes.c_int, pointers, integers
        )
        self._text = self._extension(
            "eglQueryDeviceStringEXT", ctypes.c_char_p, ctypes.c_void_p, ctypes.c_int
        )
        signature = (ctypes.c_uint, ctypes.c_void_p, ctypes.c_int, ctypes.POINTER(_Value))
        self._attribute = self._extension("eglQueryDeviceAttribEXT", *signature)
        self.display_attribute = self._extension("eglQueryDisplayAttribEXT", *signature)
        self.gl_string = self._extension("glGetString", ctypes.c_char_p, ctypes.c_uint)

    def devices(self) -> list[tuple[int | None, EglDevice]]:
        """Return all devices in EGL's order, each with its handle."""
        handles, number = (ctypes.c_void_p * _MOST_DEVICES)(), ctypes.c_int()
        if not self._query(_MOST_DEVICES, handles, ctypes.byref(number)):
            return []

        devices = []
        for i, handle in enumerate(handles[: number.value]):
            extensions = (self._text(handle, _EXTENSIONS) or b"").decode().split()
            cuda = None
            if _CUDA in extensions:
                cuda = self.value(self._attribute, handle, _CUDA_DEVICE)
            devices.append((handle, EglDevice(i, _SOFTWARE in extensions, cuda)))
        return devices

    def value(self, query: Callable[..., int], handle: int | None, attribute: int) -> int | None:
        """Return the value of an attribute of a device or a display; None if it has no value."""
        value = _Value(-1)
        if not query(handle, attribute, ctypes.byref(value)) or value.value < 0:
            return None
        return value.value

    def _extension(self, name: str, result: Any, *arguments: Any) -> Any:
        """Return a function of EGL; `result` and `arguments` are its types."""
        address = self.library.eglGetProcAddress(name.encode())
        if not address:
            raise AttributeError(name)
        return ctypes.CFUNCTYPE(result, *arguments)(address)


def _functions() -> _Functions | None:
    try:
        return _Functions()
    except (OSError, AttributeError):
        return None


GPUS = "CUDA_VISIBLE_DEVICES"
EGL_DEVICE = "MUJOCO_EGL_DEVICE_ID"
# Variables that name the files of Vulkan drivers. SAPIEN's older loader only reads the first.
VULKAN_DRIVERS = ("VK_ICD_FILENAMES", "VK_DRIVER_FILES")
_ICD_FOLDERS = ("/usr/local/share/vulkan/icd.d", "/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
# Part of the path of SAPIEN's own description of NVIDIA's driver. SAPIEN sets this path in the
# variables above if it finds no other driver.
_SAPIENS_OWN = "sapien/vulkan_library/"
_SOFTWARE_VULKAN = "llvmpipe"  # beginning of the name of lavapipe's device

SHARE = "worker: {gpus: 0.25}, or --worker-gpus 0.25, gives each worker a part of a GPU"
_CURE_HIDDEN = (
    f"{SHARE}; to render in software install Mesa's drivers (libegl1 libgl1-mesa-dri "
    "mesa-vulkan-drivers) on that node"
)
_CURE_OWN = (
    "install the NVIDIA driver's graphics part on that node (libnvidia-gl; in a container "
    "NVIDIA_DRIVER_CAPABILITIES=all), or leave worker.gpus at 0 to render in software; if it is "
    f"intended, set render_backend in env_options (ManiSkill) or {EGL_DEVICE} in "
    "worker.runtime_env.env_vars"
)


@dataclass(frozen=True, slots=True)
class Renderer:
    """A device that renders an env's images."""

    # The driver's name of the device: "llvmpipe (LLVM 15.0.6, 256 bits)", "NVIDIA H200/PCIe/SSE2".
    name: str
    software: bool
    # Index among the CUDA devices that this process may use; None if the device is not one of
    # these.
    cuda: int | None
    asked_for: bool = False  # whether the environment's options select this device


def has_gpu() -> bool | None:
    """Return whether this process has a GPU; None if CUDA_VISIBLE_DEVICES is not set."""
    visible = os.environ.get(GPUS)
    return None if visible is None else visible.strip() not in ("", "-1")


def fitting(devices: Sequence[EglDevice], *, gpu: bool) -> EglDevice | None:
    """Return the device on which to render.

    Args:
        devices: The devices of EGL.
        gpu: Whether to render on a GPU.

    Returns:
        CUDA's first device or, if `gpu` is False, the software device; None if there is no such
        device.
    """
    if gpu:
        gpus = [device for device in devices if device.cuda is not None]
        return min(gpus, key=lambda device: device.cuda or 0, default=None)
    return next((device for device in devices if device.software), None)


def prepare_rendering() -> None:
    """Set the environment variables of drivers and simulators for rendering without a display and
    on shared cores.

    Variables set by the user are kept. Call this before any simulator is imported: ManiSkill also
    imports MuJoCo, which chooses its OpenGL backend once, on import.
    """
    # Otherwise Mesa's software drivers would use all cores.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    if not os.environ.get("MUJOCO_GL") and not os.environ.get("DISPLAY") and _has_egl():
        os.environ["MUJOCO_GL"] = "egl"
    choose_devices()


def choose_devices() -> None:
    """Set the environment variables that select the devices; call this before libraries are
    loaded.

    Variables set by the user are kept.
    """
    gpu = has_gpu()
    if gpu is None:
        return

    if EGL_DEVICE not in os.environ:
        device = fitting(devices(), gpu=gpu)
        if device is not None:
            os.environ[EGL_DEVICE] = str(device.number)

    if not gpu and not any(os.environ.get(name) for name in VULKAN_DRIVERS):
        driver = _lavapipe()
        if driver is not None:
            os.environ[VULKAN_DRIVERS[0]] = str(driver)


def opengl_renderer() -> Renderer | None:
    """Return the renderer of this thread's OpenGL context.

    Returns:
        The renderer; None if there is no context, or if EGL did not create it.
    """
    functions = _functions()
    if functions is None:
        return None
    display = functions.library.eglGetCurrentDisplay()
    if not display:
        return None

    handle = functions.value(functions.display_attribute, display, _DEVICE)
    device = next((device for pointer, device in functions.devices() if pointer == handle), None)
    name = functions.gl_string(_GL_RENDERER)
    if device is None or name is None:
        return None
    asked_for = os.environ.get(EGL_DEVICE) == str(device.number)
    return Renderer(name.decode(errors="replace"), device.software, device.cuda, asked_for)


def vulkan_renderer(name: str, cuda: int | None, *, asked_for: bool = False) -> Renderer:
    """Return the renderer for the device that SAPIEN uses.

    Args:
        name: SAPIEN's name of the device.
        cuda: The index of the device among the CUDA devices; None if it is not a CUDA device.
        asked_for: Whether the env's options select the device.
    """
    files = filter(None, map(os.environ.get, VULKAN_DRIVERS))
    driver_set = has_gpu() is False and any(_SAPIENS_OWN not in file for file in files)
    return Renderer(name, name.startswith(_SOFTWARE_VULKAN), cuda, asked_for or driver_set)


def require_own(renderer: Renderer) -> None:
    """Check that a renderer is a device that this process may use.

    Raises:
        ConfigError: The renderer is not the GPU assigned to this process, or it is a GPU although
            no GPU is assigned.
    """
    gpu = has_gpu()
    if gpu is None or renderer.asked_for:
        return
    is_right = renderer.cuda is not None if gpu else renderer.software
    if is_right:
        return

    if gpu:
        raise ConfigError(
            f"the GPU {os.environ[GPUS]} is assigned to the worker, but its env renders on "
            f"{renderer.name!r}; {_CURE_OWN}"
        )
    raise ConfigError(
        f"no GPU is assigned to the worker (worker.gpus: 0), but its env renders on "
        f"{renderer.name!r}, which a policy may be using; {_CURE_HIDDEN}"
    )


def _lavapipe() -> Path | None:
    """Return the description of Mesa's software driver for Vulkan; None if it is not installed."""
    for folder in _ICD_FOLDERS:
        files = sorted(Path(folder).glob("lvp_icd*.json"))
        if files:
            return files[0]
    return None


def _has_egl() -> bool:
    """Return whether EGL's library can be loaded."""
    try:
        # Without this library, `MUJOCO_GL=egl` makes `import mujoco` fail.
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True


# Probes: tests whether this machine can render.

# Time limit, s. A software driver compiles its shaders in 3 to 10 s, and took more than 60 s beside
# 12 other processes on two cores.
TIMEOUT_S = 180.0

VULKAN_CURE = (
    "install a Vulkan driver: Mesa 25 renders in software (Debian 12: apt-get install -t "
    "bookworm-backports mesa-vulkan-drivers, its own 22.3 is too old; elsewhere: "
    "mesa-vulkan-drivers); for an unpacked one set VK_ICD_FILENAMES to its lvp_icd.json"
)
VULKAN_CURE_NVIDIA = (
    "an NVIDIA driver is here but no Vulkan device: install the driver's graphics part "
    "(libnvidia-gl), or start the container with NVIDIA_DRIVER_CAPABILITIES=all"
)
EGL_CURE = (
    "install EGL: apt-get install libegl1 libgl1-mesa-dri renders in software; on NVIDIA the "
    "driver's graphics part (libnvidia-gl), in a container NVIDIA_DRIVER_CAPABILITIES=all; "
    "MUJOCO_GL must be set before mujoco is imported"
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

    ok: bool
    seconds: float  # run time of the child process, including imports
    # The driver's name of the device; "llvmpipe ..." is Mesa's software driver.
    device: str | None = None
    error: str | None = None
    cure: str | None = None
    devices: tuple[EglDevice, ...] = ()  # all devices of EGL, if EGL was tried


@functools.cache
def render_probe(timeout_s: float = TIMEOUT_S) -> RenderProbe:
    """Render one frame with SAPIEN, which needs a Vulkan device."""
    return _probed("vulkan", "sapien", vulkan_cure(), timeout_s)


@functools.cache
def egl_probe(timeout_s: float = TIMEOUT_S) -> RenderProbe:
    """Render one frame with MuJoCo through EGL, i.e. without a display."""
    return _probed("egl", "mujoco", EGL_CURE, timeout_s)


def vulkan_cure() -> str:
    """Return the text that explains how to give SAPIEN a rendering device on this machine."""
    nvidia = Path("/dev/nvidiactl").exists() or shutil.which("nvidia-smi") is not None
    return VULKAN_CURE_NVIDIA if nvidia else VULKAN_CURE


def vulkan_device(*, on_gpu: bool) -> tuple[str, int | None] | None:
    """Return the name and the CUDA index of the device on which SAPIEN renders in this process.

    Args:
        on_gpu: Whether SAPIEN was configured to render on a GPU.

    Returns:
        The device as in `usable_devices`; None if there is no device.
    """
    import sapien.render

    usable = usable_devices(sapien.render.get_device_summary())
    # The sort is stable, so devices of the same kind stay in SAPIEN's order.
    usable.sort(key=lambda device: (device[1] is not None) != on_gpu)
    return usable[0] if usable else None


def usable_devices(summary: str) -> list[tuple[str, int | None]]:
    """Return the supported devices in a summary of SAPIEN, in the summary's order.

    Args:
        summary: The text that `sapien.render.get_device_summary` returns.

    Returns:
        The name of each device, such as "llvmpipe (LLVM 15.0.6, 256 bits)", and its index among the
        CUDA devices of this process, or None if it is not a CUDA device.
    """
    usable = []
    for block in summary.split("GPU:")[1:]:
        name, *lines = block.splitlines()
        facts = {}
        for line in lines:
            key, _, value = line.partition(":")
            facts[key.strip()] = value.strip()
        if facts.get("Supported") == "1":
            cuda = int(facts.get("cudaId", "-1"))
            usable.append((name.strip(), cuda if cuda >= 0 else None))
    return usable


def _probed(api: Literal["vulkan", "egl"], module: str, cure: str, timeout_s: float) -> RenderProbe:
    """Render one frame in a child process.

    Args:
        api: The graphics interface.
        module: The module that renders.
        cure: The cure if rendering fails.
        timeout_s: Time limit of the child process, s.
    """
    if importlib.util.find_spec(module) is None:
        error, cure = f"{module} is not installed", how_to_install(module)
        return RenderProbe(ok=False, seconds=0.0, error=error, cure=cure)

    root = str(Path(vlagents_ray.__file__).parents[1])
    path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
    started = time.monotonic()
    try:
        child = subprocess.run(  # noqa: S603 - the command is this interpreter and module
            [sys.executable, "-c", f"from {__name__} import _main; _main({api!r})"],
            # SAPIEN does not read MUJOCO_GL.
            env={**os.environ, "PYTHONPATH": path, "MUJOCO_GL": "egl"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        error = f"no frame within {timeout_s:g} s"
        return RenderProbe(ok=False, seconds=time.monotonic() - started, error=error, cure=cure)

    seconds = time.monotonic() - started
    if child.returncode == 0:
        answer = json.loads(child.stdout.splitlines()[-1])
        devices = tuple(EglDevice(**device) for device in answer["devices"])
        return RenderProbe(ok=True, seconds=seconds, device=answer["device"], devices=devices)

    errors = [line.strip() for line in child.stderr.splitlines() if line.strip()]
    error = errors[-1] if errors else f"the child ended with {child.returncode}"
    return RenderProbe(ok=False, seconds=seconds, error=error, cure=cure)


def _render_vulkan() -> str | None:
    """Render a box with SAPIEN, and return the name of the device."""
    import numpy as np
    import sapien

    try:
        device = sapien.Device("cuda")
    except RuntimeError:
        device = sapien.Device("cpu")  # any Vulkan device, including a software device

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
    name_and_cuda = vulkan_device(on_gpu=device.is_cuda())
    return None if name_and_cuda is None else name_and_cuda[0]


def _render_egl() -> str | None:
    """Render a box with MuJoCo, and return the name of the device."""
    import mujoco
    import numpy as np
    from OpenGL.GL import GL_RENDERER, glGetString

    model = mujoco.MjModel.from_xml_string(_BOX_XML)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with contextlib.closing(mujoco.Renderer(model, 64, 64)) as renderer:
        renderer.update_scene(data, camera="front")
        _require_contrast(np.asarray(renderer.render()))
        name = glGetString(GL_RENDERER)
    return name.decode() if isinstance(name, bytes) else None


def _require_contrast(image: object) -> None:
    """Raise `RuntimeError` if all pixels of an image are equal."""
    import numpy as np

    if np.ptp(np.asarray(image)) == 0:
        raise RuntimeError("the frame has a single colour: the driver runs but renders nothing")


def _main(api: str) -> None:
    """Render a frame, and print the name of the device and all devices, for `_probed`."""
    name = _render_vulkan() if api == "vulkan" else _render_egl()
    all_devices = [asdict(device) for device in devices()] if api == "egl" else []
    sys.stdout.write("\n" + json.dumps({"device": name, "devices": all_devices}) + "\n")
