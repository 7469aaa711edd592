"""Layers of the virtual space on their way to the page, and the page's reports of what it renders from them."""

import asyncio
import dataclasses
import math

import aiohttp
import numpy as np
import pytest
from console_servers import WAIT_S, until

from instant_ic.console import ConsoleClient, FrameKind, PageProtocolError
from instant_ic.console import pages as pages_module
from instant_ic.console.layers import LayerMeshes, PageLayer, PageLayers
from instant_ic.console.protocol import Parts, decode_frame
from instant_ic.console.session import PART_BYTES
from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace.layer_mesh import LayerMesh
from instant_ic.vspace.layers import Content, DecodedLayer, Kind, Layer, Layers


def layer(image=b"JPEG", **values):
    """One triangle on a lattice of 2 x 4 pixels."""
    fields = {
        "image": image,
        "confidence": b"",
        "mesh": mesh((2, 4)),
        "gain": (1.0, 0.9, 1.1),
        "map_from_camera": pose_matrix(x=1.0, z=1.2, yaw=math.pi / 2),
    }
    return PageLayer(**(fields | values))


def mesh(size):
    corners, inverse_depth = np.array([[0, 0], [4, 0], [2, 2]], np.uint16), np.array([0.5, 0.25, 0.0], np.float32)
    return LayerMesh(corners, inverse_depth, np.array([[0, 1, 2]], np.uint32), size)


def layers(version, *each):
    return PageLayers(version, (0.1, 0.0, 1.2), each or (layer(),))


def test_layout_of_a_frame_by_hand():
    header, payload = layers(3, layer(confidence=b"PNG")).frame(frozenset())
    assert payload == (
        bytes.fromhex("0000003f 0000803e 00000000")  # 0.5, 0.25, 0
        + bytes.fromhex("00000000 01000000 02000000")
        + bytes.fromhex("0000 0000 0400 0000 0200 0200")
        + b"JPEG"
        + b"PNG"
    )
    (sent,) = header.pop("layers")
    assert sent.pop("parts") == {
        "inverse": [0, 12], "triangles": [12, 12], "corners": [24, 12], "image": [36, 4], "confidence": [40, 3],
    }  # fmt: skip
    assert len(sent.pop("id")) == 24
    assert sent.pop("q") == pytest.approx([0, 0, math.sqrt(0.5), math.sqrt(0.5)])
    assert sent == {"size": [2, 4], "gain": [1.0, 0.9, 1.1], "p": [1.0, 0.0, 1.2]}
    assert header == {"version": 3, "mount": [0.1, 0.0, 1.2]}


def test_a_layer_that_the_page_holds_is_not_sent_again():
    first, second = layer(b"first"), layer(b"second")
    held = layers(1, first).digests
    header, payload = layers(2, layer(b"first"), second).frame(held)
    assert [one["parts"] is None for one in header["layers"]] == [True, False]
    assert payload.endswith(b"second")
    assert b"first" not in payload
    assert layer(gain=(1.0, 1.0, 1.0)).digest == layer().digest  # gain and pose are always sent
    assert layer(mesh=mesh((2, 5))).digest != layer().digest


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"image": b""}, r"layers\[0\]\.image is empty"),
        ({"map_from_camera": np.full((4, 4), math.nan)}, "map_from_camera must be 4 x 4 finite numbers"),
        ({"gain": (1.0, math.inf, 1.0)}, "gain must be 3 finite numbers"),
    ],
)
def test_a_layer_that_no_page_could_render_is_refused_by_name(change, text):
    with pytest.raises(PageProtocolError, match=text):
        layers(1, layer(**change)).check()


def test_version_number_of_layers_and_pose_are_checked():
    for wrong in (layers(0), layers(1, *[layer()] * 9), dataclasses.replace(layers(1), mount=(0.0, 0.0, math.nan))):
        with pytest.raises(PageProtocolError, match="layers"):
            wrong.check()
    layers(1).check()


@pytest.fixture
def server(serve):
    return serve()


def sent_parts(client):
    """Version of the newest frame, and which layers came with their parts."""
    header = client.frames[FrameKind.LAYERS].header
    return header["version"], [one["parts"] is not None for one in header["layers"]]


async def next_layers(client, count):
    await client.wait_for(lambda c: c.frame_counts[FrameKind.LAYERS] == count, WAIT_S)
    return sent_parts(client), client.frames[FrameKind.LAYERS].sequence


async def test_texts_go_between_the_pieces_of_large_layers_and_one_piece_at_a_time(server):
    image = bytes(range(256)) * 1000
    server.send_layers(layers(1, layer(image)))
    url = server.url.replace("http", "ws") + "ws"
    async with aiohttp.ClientSession() as http, http.ws_connect(url) as socket:
        collected, parts, pieces = None, Parts(), 0
        while collected is None:
            message = await socket.receive(WAIT_S)
            if message.type is not aiohttp.WSMsgType.BINARY:
                continue
            part = decode_frame(message.data)
            assert part.kind is FrameKind.PART
            assert len(part.payload) <= PART_BYTES
            pieces += 1
            collected = parts.take(part)
            for number in range(3):  # the next piece waits for the acknowledgement, pongs do not
                await socket.send_json({"type": "ping", "client_ms": number})
                while (answer := await socket.receive_json(timeout=WAIT_S))["type"] != "pong":
                    pass
                assert answer["client_ms"] == number
            await socket.send_json({"type": "ack", "kind": int(FrameKind.PART), "seq": part.sequence})
        assert pieces == -(-(len(image) + 500) // PART_BYTES)
        assert collected.kind is FrameKind.LAYERS
        start, length = collected.header["layers"][0]["parts"]["image"]
        assert collected.payload[start : start + length] == image


async def test_each_page_gets_a_version_once_and_only_what_it_lacks(server):
    camera, guess = layer(b"camera"), layer(b"guess")
    server.send_layers(layers(1, camera, guess))
    async with ConsoleClient(server.url, acknowledge=False) as page:

        async def acknowledge(number, **values):
            await page.send({"type": "ack", "kind": 5, "seq": number, **values})

        found, number = await next_layers(page, 1)  # it came later than the layers
        assert found == (1, [True, True])
        for version in (2, 3):
            server.send_layers(layers(version, camera, layer(b"better")))
        await page.send({"type": "ping", "client_ms": 0})
        await asyncio.sleep(0.1)
        assert page.frame_counts[FrameKind.LAYERS] == 1  # never more than one on the way
        await acknowledge(number)
        found, number = await next_layers(page, 2)
        assert found == (3, [False, True])  # the newest, and of it what changed
        await acknowledge(number, loaded=False)
        server.send_layers(layers(4, camera, layer(b"best")))
        found, number = await next_layers(page, 3)
        assert found == (4, [True, True])  # it could not load the ones before
        await acknowledge(number, loaded="yes")
        await page.wait_for(lambda c: c.errors, WAIT_S)
        assert "ack.loaded must be true or false" in page.errors[0]


async def test_views_are_needed_unless_every_page_renders_the_newest_layers_by_itself(server, monkeypatch):
    server.send_layers(layers(5))
    news = []
    server.backend.on_drawn = lambda: news.append(server.drawn_ms())
    async with ConsoleClient(server.url) as driver, ConsoleClient(server.url) as watcher:
        await driver.acquire()
        await until(lambda: FrameKind.LAYERS in driver.frames)
        assert server.needs_views()
        assert server.drawn_ms() is None

        async def drawn(page, version, state_ms):
            await page.send({"type": "drawn", "version": version, "state_ms": state_ms})

        now_ms = server.now_ms()
        await drawn(driver, 5, now_ms - 30)
        await until(lambda: server.drawn_ms() == now_ms - 30)
        assert news == [now_ms - 30]
        assert server.needs_views()  # the watcher's page does not
        server.send_frame(FrameKind.VIEW, {"n": 1}, b"view")
        await watcher.wait_for(lambda c: FrameKind.VIEW in c.frames, WAIT_S)
        assert FrameKind.VIEW not in driver.frames
        await drawn(watcher, 5, now_ms)
        await until(lambda: not server.needs_views())
        assert server.drawn_ms() == now_ms - 30  # the driver's counts
        # What the page shows of outdated layers, or of those of another server, is no news.
        monkeypatch.setattr(pages_module, "SUPERSEDED_S", 0.05)
        server.send_layers(layers(6))
        await asyncio.sleep(0.3)
        for version in (5, 99):
            await drawn(driver, version, now_ms)
        await drawn(driver, 6, now_ms + 1)
        await until(lambda: server.drawn_ms() == now_ms + 1)
        assert news == [now_ms - 30, now_ms + 1]
        await drawn(driver, 0, now_ms + 2)
        await until(server.needs_views)
        assert server.drawn_ms() is None
        await drawn(driver, 99, now_ms + 3)
        await until(lambda: server.drawn_ms() == 0.0)  # as old as can be: a view that is stale
        for bad in ({"version": -1, "state_ms": 0}, {"version": 6, "state_ms": now_ms + 1e7}, {"version": 6}):
            await driver.send({"type": "drawn", **bad})
        await driver.wait_for(lambda c: len(c.errors) == 3, WAIT_S)
    await until(lambda: server.drawn_ms() is None)


def encoded(number, kind=Kind.SEEN, gain=(1.0, 1.0, 1.0)):
    return Layer(kind, number, pose_matrix(), gain, 0.0, b"JPEG", 1.0, b"PNG", 1, 1)


def version_of(*layers):
    return Layers(1, layers)


def test_meshes_are_made_once_and_what_was_seen_comes_before_all_guesses(monkeypatch):
    """Panoramas of 8 x 16 pixels, 2 m away everywhere; a guess in one quad."""
    calls = []
    content = np.full((8, 16), Content.SURFACE)
    guess = np.full((8, 16), Content.NOTHING)
    guess[3, 5] = Content.SURFACE

    def decoded(one):
        calls.append(one.keyframe_id)
        marks = guess if one.kind is Kind.BEHIND else content
        depth, zeros = np.full((8, 16), 0.5, np.float32), np.zeros((8, 16), np.float32)
        return DecodedLayer(np.zeros((8, 16, 3), np.uint8), depth, marks, zeros, zeros > 0)

    monkeypatch.setattr("instant_ic.console.layers.decode_layer", decoded)
    meshes = LayerMeshes()
    first = meshes.layers(version_of(encoded(1), encoded(2, Kind.BEHIND), encoded(3)))
    assert [bool(one.confidence) for one in first] == [False, False, True]
    again = meshes.layers(version_of(encoded(1, gain=(0.9, 1.0, 1.0)), encoded(2, Kind.BEHIND)))
    assert calls == [1, 3, 2]
    assert again[0].gain == (0.9, 1.0, 1.0)
    assert again[0].digest == first[0].digest
    assert again[1] is first[2]
    PageLayers(1, (0.0, 0.0, 1.2), again).check()
    # A guess in the quad right of and below (3, 5) has four pixels, each a square of its own at its rim.
    columns, rows = again[1].mesh.corners.T
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (5, 7, 3, 5)
    meshes.layers(version_of(encoded(4)))
    meshes.layers(version_of(encoded(1)))
    assert calls == [1, 3, 2, 4, 1]  # forgotten meanwhile
