"""Admission of messages to a replica before they are decoded: their charge, memory limits, and the
decoding thread.

A message has a `MessageAdmission` from its arrival until it is answered. Decoders use it as their
`Budget`, so that these limits apply before anything is decoded:

- The message was charged to the caller's key when it arrived (`vlagents_ray.serve.access.charges`),
  or it is rejected. Each further request in the message is charged when the request's header is
  parsed (429).
- Its decoded size is bounded by `limits.decoded_bytes` (413). With the rate limit, that bounds a
  key's bytes a second.
- All messages of a replica together take at most `limits.in_flight_bytes`; a quarter is reserved
  for robots (503).
- The thread that reads a message, which is the policy's thread or an event loop, decodes only JPEG
  of at most a quarter of a megapixel in all, whose cost is bounded. Other images, and headers of
  more than 64 KiB, are decoded on separate threads. Messages of simulations, and messages whose
  images take longer than 60 ms, are decoded on half of the cores.
- The CPU time of decoding is charged to the key.
- While batches are slow and several sessions act, images of robots that take more than 0.4 ms are
  also decoded on these threads, if there are four cores. Robots that are answered together send
  their next messages together, and one thread would decode these one after another.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol, TypeVar

import numpy as np

from vlagents_ray.errors import MessageTooLarge, Overloaded, PolicyUnavailable
from vlagents_ray.images import thread_map
from vlagents_ray.protocol.messages import Budget, MessageLimits, Request
from vlagents_ray.serve.access.charges import Charge

T = TypeVar("T")

# Limits above which another thread decodes: the bytes of a quarter of a megapixel, of the files and
# decoded, and the time in which one core decodes such a JPEG of the highest quality.
INLINE_BYTES = 3 * 2**18
INLINE_S = 4e-3
# The time above which a robot's message is not decoded on the threads for robots, s, so that other
# robots do not wait for longer than two ticks: about the time of four images of 1920x1080.
LONG_S = 60e-3
# Time limit while the messages of several sessions are decoded in parallel, s. A shorter decoding
# takes about as long as the thread switch.
SIDE_BY_SIDE_S = 0.4e-3
# Minimum number of cores with which messages are decoded in parallel. On two cores, both already
# decode the images of one message, and more threads only delay the threads of the policy and the
# clients.
SIDE_BY_SIDE_CORES = 4
# Memory of a request from its arrival until its answer, without images and arrays.
REQUEST_BYTES = 2048
_ROBOTS_SHARE = 0.25  # share of the bytes in flight that is reserved for robots
_KEYS_SHARE = 0.5  # share of the bytes left free by other keys that one key may take


class NeedsDecodingThread(Exception):
    """Raised when decoding a message would take too long on the current thread."""


class OverlapsBatches(Protocol):
    """The window of a replica's batches, `BatchWindow`."""

    overlaps: bool
    """Whether other threads should work on the next requests while a batch runs."""


class Admission:
    """The bytes in flight of one replica, and the threads that decode large messages.
    Thread-safe.
    """

    def __init__(self, in_flight_bytes: int, window: OverlapsBatches | None = None) -> None:
        """Create the admission of a replica, without bytes in flight.

        Args:
            in_flight_bytes: Largest number of bytes in flight of all messages together.
            window: The window of the replica's batches, which determines when messages of several
                sessions are decoded in parallel; None to decode small messages on the threads that
                read them.
        """
        self._window = window
        has_cores = window is not None and thread_map.allowed() >= SIDE_BY_SIDE_CORES
        # The smallest possible result of `inline_s`, s. Decoding most messages takes less.
        self.least_inline_s = SIDE_BY_SIDE_S if has_cores else INLINE_S
        # Maximum number of bytes in flight of all messages together, for messages of robots (True)
        # and of simulations (False).
        self._limits = {True: in_flight_bytes, False: int(in_flight_bytes * (1 - _ROBOTS_SHARE))}
        self.held = 0  # number of bytes in flight
        # Bytes to release with each message that has no admission.
        self.messages: dict[weakref.ref[Any], int] = {}
        # Number of bytes in flight by the name of the sender's key.
        self._held_by: Counter[str] = Counter()
        # Number of bytes of incomplete messages, the oldest first.
        self._arriving: dict[ArrivingBytes, int] = {}
        # Number of these bytes by the name of the sender's key.
        self._arriving_by: Counter[str | None] = Counter()
        # Reentrant: the garbage collector may release a message in a section that holds this lock.
        self._lock = threading.RLock()
        # The thread pool for robots (True), and the thread pool for all others (False).
        self._threads: dict[bool, ThreadPoolExecutor] = {}
        # Number of robots' messages that the threads decode, or that wait for a thread.
        self._decoding_robots = 0
        self._closed = False

    def hold(self, size: int, robot: bool, message_bytes: int, key: str | None = None) -> None:
        """Count `size` more bytes as in flight for a message that already holds `message_bytes`
        bytes.

        If there is no room, incomplete messages are given up before an error is raised.

        Args:
            robot: Whether the message may use the bytes reserved for robots.
            key: The name of the sender's key, which may take a share of what other keys leave free;
                None without a key.

        Raises:
            Overloaded: The bytes in flight leave no room at the moment.
            MessageTooLarge: The message alone exceeds the limit.
        """
        limit = self._limits[robot]
        message_limit = limit if key is None else int(limit * _KEYS_SHARE)
        if message_bytes + size > message_limit:
            raise MessageTooLarge(
                f"message: takes {message_bytes + size} bytes when decoded, but all messages in "
                f"flight may take only {message_limit}; send fewer requests at once, or raise "
                "`limits.in_flight_bytes`"
            )

        given_up: list[ArrivingBytes] = []
        with self._lock:
            # This computes the result of `_room` without its call, which saves time for each act of
            # a robot without a key.
            room = limit - self.held if key is None else self._room(limit, key)
            while size > room:
                arriving = self._largest_arriving(size, limit, robot, key)
                if arriving is None:
                    break
                self._resize(arriving, 0)
                given_up.append(arriving)
                room = self._room(limit, key)

            held_bytes, has_room = self.held, size <= room
            if has_room:
                self._count(size, key)

        for arriving in given_up:
            arriving.give_up()
        if not has_room:
            raise Overloaded(
                f"the messages in flight at this replica take {held_bytes} of at most {limit} "
                "bytes, and one key may take half of the bytes that other keys leave free; send "
                f"the request again after {Overloaded.retry_after_s:g} s, or raise "
                "`limits.in_flight_bytes`"
            )

    def release(self, size: int, key: str | None = None) -> None:
        """Count `size` bytes as no longer in flight."""
        with self._lock:
            self._count(-size, key)

    def resize(self, arriving: ArrivingBytes, size: int) -> None:
        """Set the number of bytes of incomplete messages to `size`; raise `Overloaded` if there is
        no room for more.
        """
        limit = self._limits[arriving.robot]
        with self._lock:
            more = size - self._arriving.get(arriving, 0)
            has_room = more <= 0 or more <= self._room(limit, arriving.key)
            if has_room:
                self._resize(arriving, size)
        if not has_room:
            raise Overloaded(
                "the messages in flight leave too little memory for a message that arrives this "
                "slowly; send it again"
            )

    def _room(self, limit: int, key: str | None) -> int:
        """Return how many bytes a sender may take; the caller holds the lock."""
        room = limit - self.held
        return room if key is None else min(room, self._room_of_key(limit, key))

    def _room_of_key(self, limit: int, key: str) -> int:
        """Return how many bytes a key may take if the incomplete messages of other keys are given
        up.
        """
        arriving_of_others = sum(self._arriving_by.values()) - self._arriving_by[key]
        by_others = self.held - self._held_by[key] - arriving_of_others
        return int(_KEYS_SHARE * (limit - by_others)) - self._held_by[key]

    def _largest_arriving(
        self, size: int, limit: int, robot: bool, key: str | None
    ) -> ArrivingBytes | None:
        """Return incomplete messages to give up: messages of the key with the most bytes, or
        messages of `key` if it is over its share. Incomplete messages of robots are not given up
        for a simulation. The result is None if there is nothing to give up. The caller holds the
        lock.
        """
        candidates = [arriving for arriving in self._arriving if robot or not arriving.robot]
        if key is not None and size > self._room_of_key(limit, key):
            candidates = [arriving for arriving in candidates if arriving.key == key]
        return max(candidates, key=lambda arriving: self._held_by[arriving.key or ""], default=None)

    def _resize(self, arriving: ArrivingBytes, size: int) -> None:
        before = self._arriving.get(arriving, 0)
        self._count(size - before, arriving.key)
        self._arriving_by[arriving.key] += size - before
        if not self._arriving_by[arriving.key]:
            del self._arriving_by[arriving.key]
        if size:
            self._arriving[arriving] = size
        else:
            self._arriving.pop(arriving, None)

    def _count(self, size: int, key: str | None) -> None:
        self.held += size
        if key is not None:
            self._held_by[key] += size
            if not self._held_by[key]:
                del self._held_by[key]

    def release_with(self, message: weakref.ref[Any]) -> None:
        """Release the bytes of a message that is answered or dropped: this is the callback of the
        weak references to messages.
        """
        size = self.messages.pop(message, 0)
        with self._lock:
            self.held -= size

    def submit(self, call: Callable[[], T], robot: bool) -> Future[T]:
        """Run `call` on a decoding thread; raise `PolicyUnavailable` after `close`."""
        with self._lock:
            if self._closed:
                raise _stopping()
            threads = self._threads.get(robot)
            if threads is None:
                cores = thread_map.allowed()
                number = max(1, cores // 2)
                if robot:
                    # The policy's thread mostly waits for a GPU while messages are decoded in
                    # parallel.
                    number = cores if cores >= SIDE_BY_SIDE_CORES else max(1, cores - 1)
                name = f"decode-{'robots' if robot else 'others'}"
                threads = self._threads[robot] = ThreadPoolExecutor(number, name)
            if not robot:
                return threads.submit(call)
            self._decoding_robots += 1
            return threads.submit(self._counted, call)

    def _counted(self, call: Callable[[], T]) -> T:
        """Run a call that decodes a robot's message, and count it until it ends."""
        try:
            return call()
        finally:
            with self._lock:
                self._decoding_robots -= 1

    def inline_s(self, robot: bool) -> float:
        """Return the decoding time, s, above which a thread with other work leaves the images of a
        message to a decoding thread.
        """
        is_side_by_side = robot and self._window is not None and self._window.overlaps
        return self.least_inline_s if is_side_by_side else INLINE_S

    def has_spare_cores(self) -> bool:
        """Return whether the images of a long message are decoded on several threads."""
        return thread_map.allowed() >= SIDE_BY_SIDE_CORES

    def fills_cores(self) -> bool:
        """Return whether the messages of robots that are being decoded keep all cores busy with one
        thread for each message. If not, the two or three images of a message are decoded on several
        threads.
        """
        return 2 * self._decoding_robots > thread_map.allowed()

    def close(self) -> None:
        """Cancel waiting decoding jobs, and accept no more."""
        with self._lock:
            self._closed = True
            pools = list(self._threads.values())
        for pool in pools:
            pool.shutdown(wait=False, cancel_futures=True)


class ArrivingBytes:
    """The bytes of a connection's messages that are incomplete, or that the application has not
    read. Thread-safe.
    """

    def __init__(
        self, admission: Admission, key: str | None, robot: bool, give_up: Callable[[], None]
    ) -> None:
        """Create a count of 0 bytes.

        Args:
            key: The name of the connection's key; None without a key.
            robot: Whether the bytes reserved for robots may be used.
            give_up: Ends the connection if a complete message needs the memory; called on any
                thread.
        """
        self.key, self.robot, self.give_up = key, robot, give_up
        self._admission = admission

    def resize(self, size: int) -> None:
        """Set the number of bytes to `size`; raise `Overloaded` if there is no room for more."""
        self._admission.resize(self, size)

    def release(self) -> None:
        """Set the number of bytes to 0."""
        self._admission.resize(self, 0)


class MessageAdmission(Budget):
    """The admission of one message, until the message is answered or dropped. Not thread-safe."""

    __slots__ = (
        "_admission",
        "_decoded",
        "_decoding_s",
        "_examined",
        "_held",
        "_images",
        "_images_used",
        "_inline",
        "_is_short",
        "_key",
        "_requests",
        "_robot",
        "charge",
        "size",
    )

    def __init__(
        self,
        admission: Admission,
        limits: MessageLimits,
        charge: Charge,
        size: int = 0,
        *,
        robot: bool = True,
        inline: bool = True,
        keep_files: bool = False,
        share: str | None = None,
    ) -> None:
        """Create the admission of one message.

        Args:
            charge: The charge of the message to the sender's key.
            size: Bytes of the message itself, which the replica keeps while it works on the
                message.
            robot: Whether the message may use the bytes reserved for robots, if the key allows it.
            inline: Whether the first decoding thread also has other work, so that large messages
                are decoded elsewhere.
            keep_files: Whether `files` keeps the files of the message's images.
            share: The name under which a sender without a key has a share of the bytes in flight;
                None for no separate limit.
        """
        super().__init__(limits)

        self.files = {} if keep_files else None
        self.charge = charge
        self._admission = admission
        self.size = size  # size of the message, until it is counted
        self._robot = robot and charge.is_robot
        self._key = charge.key or share
        self._held = 0  # bytes counted as in flight
        self._decoded = 0  # decoded bytes among `_held`
        self._decoding_s = 0.0  # estimated time of decoding the images so far, s
        self._requests = 0  # number of requests so far that are charged
        self._inline = inline
        self._examined = 0  # bytes of image files so far
        # Whether a thread for robots decodes the message, so that a long message is decoded
        # elsewhere.
        self._is_short = False
        # The decoded files and their images in order, while another thread may have to read the
        # message again, and the number of images that this thread has used.
        self._images: list[tuple[bytes, np.ndarray]] = []
        self._images_used = 0

    def begin_message(self) -> None:
        """Raise an error if the message is rejected, as in `Budget`. The message was charged when
        it arrived.
        """
        self.charge.require()

    def parse(self, size: int) -> None:
        """Count the memory for JSON, as in `Budget`; raise `NeedsDecodingThread` on a thread
        with other work.
        """
        if self._inline:
            raise NeedsDecodingThread
        super().parse(size)

    def begin(self, op: object, priority: object = "robot") -> None:
        """Begin the next request, as in `Budget`, and charge it; the first request was charged with
        its message.
        """
        self._refill()
        if priority == "simulation":
            self._robot = False
        if op != "close":
            self.charge.cover(self._requests + 1)
            self._requests += 1

        # An inline message is small, and is decoded on a thread with other work.
        if not self._inline:
            is_parallel = self._robot and (self._is_short or self._admission.has_spare_cores())
            self.serial = not is_parallel or self._admission.fills_cores()
        if self.size:
            self.grow(self.size)
            self.size = 0

    def receive(self, size: int) -> None:
        """Count bytes of the message itself as in flight; raise the errors of `Admission.hold`."""
        self._admission.hold(size, self._robot, self._held, self._key)
        self._held += size

    def grow(self, size: int) -> None:
        """Set the number of bytes in flight of the message itself to `size`; raise the errors of
        `receive`.
        """
        if size > self._held:
            self.receive(size - self._held)

    def hold(self, size: int) -> None:
        """Count bytes to be allocated, as in `Budget`; raise `NeedsDecodingThread` if that takes
        too long here.
        """
        self.count(size)
        if self._inline and self._decoded + size > INLINE_BYTES:
            raise NeedsDecodingThread
        self.receive(size)
        self._decoded += size

    @contextlib.contextmanager
    def decoding(
        self, seconds: float, scratch_bytes: int, *, is_bounded: bool = True
    ) -> Iterator[None]:
        """Count the decoding of images, as in `Budget`; raise `NeedsDecodingThread` if it takes
        too long here.
        """
        self._decoding_s += seconds
        if self._inline and not is_bounded:
            raise NeedsDecodingThread
        may_take_long = self._inline and self._decoding_s > self._admission.least_inline_s
        if may_take_long and self._decoding_s > self._admission.inline_s(self._robot):
            raise NeedsDecodingThread
        if self._is_short and self._decoding_s > LONG_S:
            raise NeedsDecodingThread
        with super().decoding(seconds, scratch_bytes):
            self.receive(scratch_bytes)
            try:
                yield
            finally:
                self._admission.release(scratch_bytes, self._key)
                self._held -= scratch_bytes

    def examine(self, size: int) -> None:
        """Count bytes of image files, as in `Budget`; raise `NeedsDecodingThread` if the check of
        their structure takes too long here.
        """
        self._examined += size
        if self._inline and self._examined > INLINE_BYTES:
            raise NeedsDecodingThread

    def spend(self, seconds: float) -> None:
        """Charge the CPU time of decoding to the key, as in `Budget`."""
        self.charge.spend(seconds)

    def image_of(self, file: bytes) -> np.ndarray | None:
        """Return the image of the next file if it was decoded before, as in `Budget`."""
        if self._images_used < len(self._images):
            known_file, image = self._images[self._images_used]
            if known_file == file:
                self._images_used += 1
                return image
            # The sender has changed the message in shared memory.
            del self._images[self._images_used :]
        return None

    def keep_image(self, file: bytes, image: np.ndarray) -> None:
        """Keep the decoded image of the next file, as in `Budget`."""
        if self._inline or self._is_short:
            self._images.append((file, image))
            self._images_used += 1

    def decode_here(self, read: Callable[[Budget], T]) -> T:
        """Decode with `read` on this thread, and return the result; raise `NeedsDecodingThread` if
        another thread has to read the message again.
        """
        result = read(self)
        self._images = []
        return result

    def decode_on_thread(self, read: Callable[[Budget], T]) -> Future[T]:
        """Decode with `read` on a decoding thread, and return the future, whose error is
        `PolicyUnavailable` if the replica stops before; raise the same after `close`.
        """
        self._is_short = self._robot
        self._begin_again()
        job = self._admission.submit(lambda: self.decode_here(read), self._robot)
        done: Future[T] = Future()
        jobs = [job]  # the attempts to decode the message
        done.add_done_callback(lambda _: jobs[-1].cancel())

        def finish(job: Future[T]) -> None:
            """Return the result, or decode a long message on the threads for others."""
            error = _stopping() if job.cancelled() else job.exception()
            if isinstance(error, NeedsDecodingThread) and not done.cancelled():
                self._is_short = False
                self._begin_again()
                try:
                    jobs.append(self._admission.submit(lambda: self.decode_here(read), False))
                except PolicyUnavailable as stopping:
                    error = stopping
                else:
                    jobs[-1].add_done_callback(finish)
                    return
            if not done.set_running_or_notify_cancel():
                return
            if error is None:
                done.set_result(job.result())
            else:
                done.set_exception(error)

        job.add_done_callback(finish)
        return done

    def _begin_again(self) -> None:
        """Prepare for another thread that reads the message from its beginning."""
        self._admission.release(self._decoded, self._key)
        self._held -= self._decoded
        self._decoded = 0
        self._decoding_s = 0.0
        self._refill()
        self._requests = 0  # the requests are read again, and each request is charged only once
        self._images_used = 0
        self._inline = False

    async def decoded(self, read: Callable[[Budget], T], *, long: bool = False) -> T:
        """Decode with `read` and return the result; if it is `long`, the images are large, or a
        decoding thread has already decoded a part of the message, use a decoding thread.
        """
        if self._inline and not long:
            try:
                return self.decode_here(read)
            except NeedsDecodingThread:
                pass
        return await asyncio.wrap_future(self.decode_on_thread(read))

    def release(self) -> None:
        """Release the bytes of a message that is answered or dropped."""
        held_bytes, self._held, self._decoded = self._held, 0, 0
        self._images = []
        if held_bytes:
            self._admission.release(held_bytes, self._key)

    def __del__(self) -> None:
        self.release()


def _stopping() -> PolicyUnavailable:
    return PolicyUnavailable("the replica is stopping; connect again")


def image_bytes(request: Request) -> int:
    """Return the decoded size of all images of a request, including its history, in bytes."""
    observations = request.history if request.obs is None else [request.obs, *request.history]
    size = 0
    for obs in observations:
        size += sum([image.nbytes for image in obs.cameras.values()])
    return size
