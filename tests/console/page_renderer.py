"""The operator page's own renderer in Chromium: views of the virtual space, read back from its canvas."""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic import console
from instant_ic.console.layers import PageLayers
from instant_ic.console.protocol import FrameKind, PageFrame, encode_frame

_STATIC = Path(console.__file__).parent / "static"
_ORIGIN = "http://page.invalid/"
_TIMEOUT_MS = 60_000
_SETUP = """async ([width, height, full]) => {
    const [{GlViewer}, {Images}, {decodeFrame}, {plain}] = await Promise.all(
        ["viewer", "images", "messages", "colour"].map((name) => import(`/${name}.js`)));
    const canvas = document.querySelector("canvas");
    [canvas.width, canvas.height] = [width, height];
    const viewer = new GlViewer(canvas, full);
    const loaded = [], link = {acknowledge: (frame, fine = true) => loaded.push(fine), serverNow: () => 0};
    const images = new Images(viewer, link);
    window.load = async () => {
        await images.takeLayers(decodeFrame(await (await fetch("/layers")).arrayBuffer()));
        if (!loaded.pop()) throw new Error("the page refused the layers");
    };
    const read = (scene) => {
        const start = performance.now(), gl = viewer.gl, rgba = new Uint8Array(4 * width * height);
        viewer.render(scene);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
        let text = "";
        for (let i = 0; i < rgba.length; i += 32768) text += String.fromCharCode(...rgba.subarray(i, i + 32768));
        return {rgba: btoa(text), ms: performance.now() - start};
    };
    window.view = (mapFromLook, position, tanHalf) =>
        read({tanHalf, mapFromLook, place: position, blend: 1, viewGain: plain});
}"""


class PageRenderer:
    """A page in Chromium that shows the layers given to :meth:`load`.

    ``full``: as with a GPU; else with the plain look-ups that the page uses where the CPU renders.
    """

    def __init__(self, browser: Any, width: int, height: int, full: bool = True) -> None:
        self.width, self.height = width, height
        self._frame = b""
        self._page = browser.new_page()
        self._page.set_default_timeout(_TIMEOUT_MS)
        self._page.route("**/*", self._answer)
        self._page.goto(_ORIGIN)
        self._page.evaluate(_SETUP, [width, height, full])

    def load(self, layers: PageLayers) -> None:
        """Show layers, encoded as the server sends them."""
        layers.check()
        self._frame = encode_frame(PageFrame(FrameKind.LAYERS, 1, *layers.frame(frozenset())))
        self._page.evaluate("load()")

    def render(self, map_from_camera: NDArray[np.floating], fov_rad: float) -> NDArray[np.uint8]:
        """Return the view along the camera's x axis, (height, width, 3), with this horizontal field of view."""
        tan = math.tan(fov_rad / 2)
        rotation, position = map_from_camera[:3, :3].ravel().tolist(), map_from_camera[:3, 3].tolist()
        values = json.dumps([rotation, position, [tan, tan * self.height / self.width]])
        seen = self._page.evaluate(f"view(...{values})")
        rgba = np.frombuffer(base64.b64decode(seen["rgba"]), np.uint8).reshape(self.height, self.width, 4)
        return np.ascontiguousarray(rgba[::-1, :, :3])

    def _answer(self, route: Any) -> None:
        name = route.request.url.removeprefix(_ORIGIN)
        if name == "":
            route.fulfill(body="<!doctype html><canvas></canvas>", content_type="text/html")
        elif name == "layers":
            route.fulfill(body=self._frame, content_type="application/octet-stream")
        elif (_STATIC / name).is_file():
            route.fulfill(path=_STATIC / name)
        else:
            route.fulfill(status=404)
