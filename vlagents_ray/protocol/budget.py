"""The cost of a message, which is checked before any of it is decoded."""

from __future__ import annotations

from vlagents_ray.errors import MessageTooLarge
from vlagents_ray.images.codecs import DecodedFiles
from vlagents_ray.protocol.messages import Limits

_JSON_FACTOR = 4  # bytes of Python's objects for each byte of JSON within the limits of `frame_layout`


class Budget:
    """The budget of one message: before an image is decoded or bytes are copied, its declared size is checked here.

    This class knows the limits only. A server's subclass also checks what the caller's key and the replica's memory
    allow, and decides on which thread to decode: `vlagents_ray.serve.engine.admission.MessageAdmission`.
    """

    __slots__ = ("_left", "files", "limits", "serial")

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.serial = False  # whether images are decoded one after the other
        self.files: DecodedFiles | None = None  # see `PixelBudget`
        self._left = limits.decoded_bytes

    @property
    def pixels(self) -> int:
        """The largest number of pixels of one image."""
        return self.limits.pixels

    def begin_message(self) -> None:
        """Count the message for its sender, before any of it is parsed; raises the error that refuses it."""

    def parse(self, size: int) -> None:
        """Count what the values of `size` bytes of JSON take, before they are parsed; raises as `hold`."""
        self._left = self.limits.decoded_bytes
        self.hold(_JSON_FACTOR * size)

    def begin(self, op: object, rank: object = "robot") -> None:
        """Begin the next request of the message, whose header is parsed; raises the error that refuses it."""
        self._left = self.limits.decoded_bytes

    def count(self, size: int) -> None:
        """Count `size` bytes of the request that are in memory already.

        Raises `MessageTooLarge` if they are too many.
        """
        self._left -= size
        if self._left < 0:
            raise MessageTooLarge(
                f"request: its images and bytes take more than {self.limits.decoded_bytes} bytes, decoded, each as "
                f"often as it is named; send fewer or smaller ones, or raise `limits.decoded_bytes`"
            )

    def hold(self, size: int) -> None:
        """Count `size` bytes that are about to be allocated for the request; raises an error if they may not be."""
        self.count(size)
