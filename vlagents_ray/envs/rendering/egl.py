"""EGL's devices, their numbers in CUDA, and the device on which the current thread renders.

The constants and functions are those of EGL_EXT_device_base, EGL_EXT_device_query, EGL_NV_device_cuda and
EGL_MESA_device_software in Khronos' registry.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

_MOST = 64  # devices
_EXTENSIONS = 0x3055
_DEVICE = 0x322C  # of a display
_CUDA_DEVICE = 0x323A
_GL_RENDERER = 0x1F01
_SOFTWARE = "EGL_MESA_device_software"
_CUDA = "EGL_NV_device_cuda"
_Value = ctypes.c_ssize_t  # EGLAttrib


@dataclass(frozen=True, slots=True)
class EglDevice:
    """A device of EGL."""

    number: int  # in EGL's own order, which is that of MUJOCO_EGL_DEVICE_ID
    software: bool
    cuda: int | None  # its number among the CUDA devices that this process may use; None if CUDA does not know it


@dataclass(frozen=True, slots=True)
class Drawing:
    """The device and driver of an OpenGL context."""

    renderer: str  # the driver's name of it: "llvmpipe (LLVM 15.0.6, 256 bits)"
    device: EglDevice


def devices() -> list[EglDevice]:
    """List all devices in EGL's order; empty if EGL is missing, or too old."""
    functions = _functions()
    return [] if functions is None else [device for _, device in functions.devices()]


def drawing() -> Drawing | None:
    """Return the device of the current OpenGL context of this thread; None if there is none, or it is not EGL's."""
    functions = _functions()
    display = None if functions is None else functions.library.eglGetCurrentDisplay()
    if functions is None or not display:
        return None
    handle = functions.value(functions.display_attribute, display, _DEVICE)
    device = next((device for pointer, device in functions.devices() if pointer == handle), None)
    name = functions.gl_string(_GL_RENDERER)
    return None if device is None or name is None else Drawing(name.decode(errors="replace"), device)


class _Functions:
    """The functions of EGL that are used here; raises `AttributeError` or `OSError` if one is missing."""

    def __init__(self) -> None:
        self.library = ctypes.CDLL("libEGL.so.1")
        self.library.eglGetProcAddress.restype = ctypes.c_void_p
        self.library.eglGetProcAddress.argtypes = [ctypes.c_char_p]
        self.library.eglGetCurrentDisplay.restype = ctypes.c_void_p
        pointers, whole = ctypes.POINTER(ctypes.c_void_p), ctypes.POINTER(ctypes.c_int)
        self._query = self._extension("eglQueryDevicesEXT", ctypes.c_uint, ctypes.c_int, pointers, whole)
        self._text = self._extension("eglQueryDeviceStringEXT", ctypes.c_char_p, ctypes.c_void_p, ctypes.c_int)
        asking = (ctypes.c_uint, ctypes.c_void_p, ctypes.c_int, ctypes.POINTER(_Value))
        self._attribute = self._extension("eglQueryDeviceAttribEXT", *asking)
        self.display_attribute = self._extension("eglQueryDisplayAttribEXT", *asking)
        self.gl_string = self._extension("glGetString", ctypes.c_char_p, ctypes.c_uint)

    def devices(self) -> list[tuple[int | None, EglDevice]]:
        """List the devices with their handles."""
        handles, number = (ctypes.c_void_p * _MOST)(), ctypes.c_int()
        if not self._query(_MOST, handles, ctypes.byref(number)):
            return []
        return [(handles[i], self._device(i, handles[i])) for i in range(number.value)]

    def value(self, ask: Callable[..., int], of: int | None, what: int) -> int | None:
        """Return the value of an attribute; None if it has none."""
        found = _Value(-1)
        return found.value if ask(of, what, ctypes.byref(found)) and found.value >= 0 else None

    def _device(self, number: int, handle: int | None) -> EglDevice:
        extensions = (self._text(handle, _EXTENSIONS) or b"").decode().split()
        cuda = self.value(self._attribute, handle, _CUDA_DEVICE) if _CUDA in extensions else None
        return EglDevice(number, _SOFTWARE in extensions, cuda)

    def _extension(self, name: str, result: Any, *arguments: Any) -> Any:
        address = self.library.eglGetProcAddress(name.encode())
        if not address:
            raise AttributeError(name)
        return ctypes.CFUNCTYPE(result, *arguments)(address)


def _functions() -> _Functions | None:
    try:
        return _Functions()
    except (OSError, AttributeError):
        return None
