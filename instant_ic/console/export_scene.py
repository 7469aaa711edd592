"""A virtual space as one HTML file to look round in and walk through, without a server."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from instant_ic.vspace.layer_mesh import LayerMesh

_STATIC = Path(__file__).parent / "static"
_IMPORT = re.compile(r'from "\./(\w+)\.js"')


@dataclass(frozen=True)
class SceneLayer:
    """A layer as the page renders it.

    Attributes:
        image: JPEG or PNG, equirectangular.
        confidence: grey PNG, white where it was seen; empty: everywhere.
        gain: factors of the colours.
        mesh: its surface.
    """

    image: bytes
    confidence: bytes
    gain: tuple[float, float, float]
    mesh: LayerMesh


def scene_html(title: str, layers: Sequence[SceneLayer]) -> str:
    """The file's text: the page's own renderer and the layers, the nearest first.

    Raises:
        ValueError: there is no layer.
    """
    if not layers:
        raise ValueError("a scene needs at least one layer")
    scene = {"title": title, "layers": [_fields(layer) for layer in layers]}
    # In a script element "</" would end it.
    data = json.dumps(scene).replace("</", "<\\/")
    modules = json.dumps({"imports": {name: _data_url(text) for name, text in _modules("scene").items()}})
    text = (_STATIC / "scene.html").read_text(encoding="utf-8")
    return text.replace("IMPORT_MAP", modules, 1).replace("SCENE_JSON", data, 1)


def _fields(layer: SceneLayer) -> dict[str, object]:
    mesh = layer.mesh
    return {
        "image": _base64(layer.image),
        "confidence": _base64(layer.confidence),
        "gain": layer.gain,
        "size": mesh.size,
        "corners": _base64(mesh.corners.astype("<u2").tobytes()),
        "inverse": _base64(mesh.inverse_depth.astype("<f4").tobytes()),
        "triangles": _base64(mesh.triangles.astype("<u4").tobytes()),
    }


def _modules(name: str) -> dict[str, str]:
    """A module and all that it imports, with imports by bare names: a data URL cannot be relative."""
    found: dict[str, str] = {}
    wanted = [name]
    while wanted:
        one = wanted.pop()
        if one in found:
            continue
        text = (_STATIC / f"{one}.js").read_text(encoding="utf-8")
        found[one] = _IMPORT.sub(r'from "\1"', text)
        code = "\n".join(line for line in text.splitlines() if line.startswith("import "))
        wanted += _IMPORT.findall(code)
    return found


def _data_url(text: str) -> str:
    return "data:text/javascript;base64," + _base64(text.encode())


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
