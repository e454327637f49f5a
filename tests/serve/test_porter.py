"""Letting clients in at a listening socket, whatever goes wrong with one of them."""

from __future__ import annotations

import os
import resource
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from vlagents_ray.serve.porter import Porter


class Door:
    """Keeps who comes, or refuses to."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.settimeout(5)
        self.guests: list[socket.socket] = []
        self.broken = False
        self.porter = Porter(self.listener, self.welcome)

    def welcome(self, guest: socket.socket) -> None:
        if self.broken:
            raise OSError
        self.guests.append(guest)

    def knock(self) -> socket.socket:
        return socket.create_connection(self.listener.getsockname(), 5)


@pytest.fixture
def door() -> Iterator[Door]:
    door = Door()
    yield door
    door.porter.close()
    for each in (door.listener, *door.guests):
        each.close()


@contextmanager
def no_descriptors_left() -> Iterator[None]:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    highest = max(map(int, os.listdir("/proc/self/fd")))
    resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 1, limits[1]))
    try:
        with ExitStack() as held:
            while True:
                try:
                    held.enter_context(open(os.devnull))
                except OSError:
                    break
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_who_comes_when_no_descriptor_is_left_is_turned_away_and_the_next_let_in(door: Door) -> None:
    for _ in range(2):
        with door.knock() as unlucky:
            with no_descriptors_left():
                door.porter.accept()
            assert unlucky.recv(1) == b""
    with door.knock():
        door.porter.accept()
    assert len(door.guests) == 1


def test_whom_the_door_cannot_take_is_turned_away_and_the_next_let_in(door: Door) -> None:
    door.broken = True
    with door.knock() as unlucky:
        door.porter.accept()
        assert unlucky.recv(1) == b""
    door.broken = False
    with door.knock():
        door.porter.accept()
    assert len(door.guests) == 1
