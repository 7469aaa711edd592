"""The virtual space as one HTML file: whole in itself, written by the command, and walked through in Chromium."""

import base64
import json
import re

import cv2
import numpy as np
import pytest
from console_pages import BROWSER_TEST, WAIT_MS, likeness_of

from instant_ic.adapters.vspace import layers_message
from instant_ic.bag import BagWriter
from instant_ic.cli.main import main
from instant_ic.console.export_scene import scene_html
from instant_ic.experiments import box_room
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import serialize
from instant_ic.vspace import VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.layers import encode

POSE = pose_matrix(0.0, -0.3, 0.1, yaw=0.4)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A bag with two versions of the layers of a room."""
    room = box_room.panorama(POSE, 256)
    space = VirtualSpace(VirtualSpaceConfig(source="warp", device="cpu", keyframes=1))
    space.set_keyframe(room.rgb, room.depth_m, POSE, 0.02)
    image = cv2.imencode(".jpg", room.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    folder = tmp_path_factory.mktemp("scene")
    with BagWriter(folder / "bag") as writer:
        for version in (1, 2):
            message = layers_message(encode(space.shown.newest, version, image, version), version)
            writer.write("/vspace/layers", "instant_ic_msgs/msg/VspaceLayers", bytes(serialize(message)), version)
    return folder / "bag"


@pytest.fixture(scope="module")
def scene(bag):
    file = bag.parent / "scene.html"
    assert main(["console", "export-scene", str(bag), "-o", str(file)]) == 0
    return file


def test_the_file_needs_nothing_else(scene, bag, capsys):
    text = scene.read_text(encoding="utf-8")
    modules = json.loads(re.search(r'<script type="importmap">(.*?)</script>', text, re.S)[1])["imports"]
    code = {name: base64.b64decode(url.partition("base64,")[2]).decode() for name, url in modules.items()}
    wanted = {name for source in code.values() for name in re.findall(r'^import .*from "([^"]*)"', source, re.M)}
    assert {"scene", "layers"} <= set(code) and wanted <= set(code)
    assert not re.search(r'(src|href)="|url\(', text)
    data = json.loads(re.search(r'id="data">(.*?)</script>', text, re.S)[1])
    assert data["title"].startswith("Keyframe 2, ") and len(data["layers"]) == 2
    assert main(["console", "export-scene", str(bag), "-o", str(bag / "no" / "x.html")]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_a_title_cannot_leave_its_place(scene, bag):
    from instant_ic.adapters.vspace import layers_of
    from instant_ic.cli.commands.console import newest_of_bag
    from instant_ic.console.layer_meshes import LayerMeshes
    from instant_ic.msg import deserialize

    received = newest_of_bag(bag)
    layers = LayerMeshes().layers(layers_of(deserialize(received.payload, received.type_name)))
    plain, hostile = (scene_html(title, layers) for title in ("room", "</script><script>alert(1)</script>"))
    assert hostile.count("</script>") == plain.count("</script>")
    with pytest.raises(ValueError, match="at least one layer"):
        scene_html("room", [])


@pytest.mark.parametrize("mark", [pytest.param(None, marks=BROWSER_TEST)])
def test_the_scene_is_walked_through(browser, scene, mark):
    page = browser.new_page(viewport={"width": 480, "height": 300})
    faults = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(scene.as_uri())
    drawn = page.locator("#scene[data-drawn]")
    drawn.wait_for(timeout=WAIT_MS)

    def state():
        return [float(value) for value in page.get_attribute("#scene", "data-drawn").split(",")]

    def seen():
        shot = cv2.imdecode(np.frombuffer(page.locator("#scene").screenshot(), np.uint8), cv2.IMREAD_COLOR)
        return shot[40:260, :, ::-1].astype(float)  # without title and help

    def expected(x, y, z, yaw, pitch):
        pose = pose_matrix(x, y, z, 0, -pitch, 0.4 + yaw)
        wide = 2 * np.arctan(np.tan(np.radians(60) / 2) * 480 / 300)
        return box_room.perspective(pose, 480, 300, wide).rgb[40:260].astype(float)

    x, y, z, yaw, pitch, *_ = state()
    assert [x, y, z] == pytest.approx([0.0, -0.3, 0.1], abs=1e-6) and yaw == 0
    assert likeness_of(seen(), expected(x, y, z, yaw, pitch)) > 0.97
    page.keyboard.down("w")
    page.wait_for_function("() => document.getElementById('scene').dataset.drawn.split(',')[0] > 0.3", timeout=WAIT_MS)
    page.keyboard.up("w")
    page.wait_for_timeout(300)
    x, y, z, yaw, pitch, *_ = state()
    assert np.arctan2(y + 0.3, x) == pytest.approx(0.4, abs=1e-3)  # ahead, as the keyframe's camera looked
    assert likeness_of(seen(), expected(x, y, z, yaw, pitch)) > 0.93
    page.keyboard.press("Home")
    page.wait_for_function("() => document.getElementById('scene').dataset.drawn.startsWith('0,-0.3')", timeout=WAIT_MS)
    page.close()
    assert not faults
