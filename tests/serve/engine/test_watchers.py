"""Several watchers of one engine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from vlagents_ray.images.codecs import DecodedFiles
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.responses import Done, Watchers


@dataclass(eq=False)
class Noting:
    """Notes requests and replies."""

    seen: list[object] = field(default_factory=list)

    def note(self, sessions: Sequence[str], items: Sequence[Request | Reply], files: DecodedFiles, done: Done) -> Done:
        self.seen += items

        def answer(replies: list[Reply]) -> None:
            done(replies)
            self.seen += replies

        return answer


def test_each_watcher_sees_messages_and_answers_until_it_ends() -> None:
    watchers, one, other = Watchers(), Noting(), Noting()
    sent: list[Reply] = []

    def message() -> tuple[Request, Reply]:
        request, reply = Request("close"), Reply()
        assert watchers.one is not None
        watchers.one.note(["a"], [request], {}, sent.extend)([reply])
        return request, reply

    watchers.add(one)
    assert watchers.one is one, "a message that one looks at makes no detour"
    first = message()
    watchers.add(other)
    second = message()
    watchers.remove(one)
    third = message()
    watchers.remove(one)
    watchers.remove(other)
    assert watchers.one is None
    assert one.seen == [*first, *second]
    assert other.seen == [*second, *third]
    assert sent == [first[1], second[1], third[1]]
