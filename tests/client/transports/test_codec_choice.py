"""The codec of the cameras depends on where the server is, not on what a link carries at the moment."""

from __future__ import annotations

import network_links
import numpy as np
import pytest
from camera_images import photograph

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.transports.base import CodecChoice, CodecName
from vlagents_ray.images.codecs import JPEG, LOSSLESS, RAW, ImageCodec

OBS = Obs({"front": photograph(seed=1), "wrist": photograph(seed=2)})
SIZE = sum(image.nbytes for image in OBS.cameras.values())


@pytest.mark.parametrize(("requested", "compressed"), [("auto", JPEG), ("exact", LOSSLESS)])
def test_pixels_are_raw_within_a_machine_and_compressed_over_a_network(
    requested: CodecName, compressed: ImageCodec
) -> None:
    choice = CodecChoice(requested)
    assert choice.codec is None
    for near, chosen in ((True, RAW), (False, compressed), (True, RAW)):  # each connection decides anew
        choice.connected(near=near)
        assert choice.codec == choice.codec_for(OBS) == chosen
    assert choice.codec_for(OBS, most_bytes=SIZE) == RAW
    assert choice.codec_for(OBS, most_bytes=SIZE - 1) == compressed
    assert choice.codec_for(Obs(state={"joints": np.zeros(7)}), most_bytes=1) == RAW


@pytest.mark.parametrize("named", ["raw", "lossless", "jpeg", ImageCodec("jpeg", 50, "420")])
def test_a_named_codec_is_taken_wherever_the_server_is(named: CodecName | ImageCodec) -> None:
    choice = CodecChoice(named)
    codec = named if isinstance(named, ImageCodec) else ImageCodec(named)
    for near in (True, False):
        choice.connected(near=near)
        assert choice.codec_for(OBS, most_bytes=1) == codec


def test_loopback_gets_raw_pixels() -> None:
    with network_links.loopback() as near:
        for transport in ("websocket", "http"):
            with RemoteAgent(near, transport=transport) as agent:  # type: ignore[arg-type]
                assert agent.codec is None
                agent.reset(OBS, "look")
                assert agent.codec == RAW
                agent.act(OBS)


def test_a_server_in_another_network_gets_compressed_images() -> None:
    with network_links.shaped("1gbit") as url:
        for transport, codec, chosen in (("websocket", "auto", JPEG), ("http", "exact", LOSSLESS)):
            with RemoteAgent(url, transport=transport, codec=codec) as agent:  # type: ignore[arg-type]
                agent.reset(OBS, "look")
                assert agent.codec == chosen
