"""A virtual space as one HTML file to look round in and walk through, without a server."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Sequence
from pathlib import Path

from instant_ic.console.layers import PageLayer, pose_fields

_STATIC = Path(__file__).parent / "static"
_IMPORT = re.compile(r'from "\./(\w+)\.js"')


def scene_html(title: str, layers: Sequence[PageLayer]) -> str:
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


def _fields(layer: PageLayer) -> dict[str, object]:
    parts = {name: _base64(part) for name, part in layer.parts.items()}
    return {"gain": layer.gain, "size": layer.size, **pose_fields(layer.map_from_camera), **parts}


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
