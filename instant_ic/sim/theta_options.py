"""Options of a Ricoh Theta Z1 as its Web API documents them: accepted and reported values.

Source: ricohapi/theta-api-specs, theta-web-api-v2.1 (options, protocols/errors).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from instant_ic.camera.config import FORMATS_FIRMWARE, OLD_PREVIEW_FORMATS, PREVIEW_FORMATS

NEVER = 65535
"""Delay that disables sleeping or switching off; the camera reports it as 0."""


class OptionError(ValueError):
    """The camera refuses a request.

    Attributes:
        code: error code of the API.
        status: HTTP status.
    """

    def __init__(self, code: str, text: str, status: int = 400) -> None:
        super().__init__(text)
        self.code, self.status = code, status


class ThetaOptions:
    """Options of a camera with a given firmware.

    Attributes:
        values: options as set by the client.
        preview: width, height and frame rate of the preview.
        formats: preview formats that the firmware offers.
    """

    def __init__(self, preview: tuple[int, int, int] = (1920, 960, 8), firmware: str = FORMATS_FIRMWARE) -> None:
        new = _numbers(firmware) >= _numbers(FORMATS_FIRMWARE)
        self.formats = PREVIEW_FORMATS if new else OLD_PREVIEW_FORMATS
        self.preview = preview
        self.values: dict[str, Any] = {"captureMode": "image", "sleepDelay": 300, "offDelay": 600}

    def set(self, options: Any) -> None:
        """Set all the given options, or none of them.

        Raises:
            OptionError: an option is unknown or has a value that the camera does not accept.
        """
        if not isinstance(options, dict) or not options:
            raise OptionError("missingParameter", "options is missing")
        chosen = self.preview
        for name, value in options.items():
            if name == "previewFormat":
                chosen = self._format(value)
            elif name not in self.values:
                raise OptionError("invalidParameterName", f"option {name} is not known")
            elif name.endswith("Delay") and not _allowed(name, value):
                raise OptionError("invalidParameterValue", f"{name} {value} is not supported")
        self.preview = chosen
        self.values.update({name: value for name, value in options.items() if name != "previewFormat"})

    def get(self, names: list[Any]) -> dict[str, Any]:
        """Return options as the camera reports them.

        Raises:
            OptionError: an option is unknown.
        """
        known = {
            **{name: 0 if value == NEVER else value for name, value in self.values.items()},
            "previewFormat": _described(self.preview),
            "previewFormatSupport": [_described(each) for each in self.formats],
        }
        for name in names:
            if name not in known:
                raise OptionError("invalidParameterName", f"option {name} is not known")
        return {name: known[name] for name in names}

    def _format(self, value: Any) -> tuple[int, int, int]:
        asked: Mapping[str, Any] = value if isinstance(value, dict) else {}
        wanted = (asked.get("width"), asked.get("height"), asked.get("framerate", 8))
        for each in self.formats:
            if each == wanted:
                return each
        raise OptionError("invalidParameterValue", f"previewFormat {value} is not supported")


def _allowed(name: str, value: Any) -> bool:
    if not isinstance(value, int):
        return False
    if name == "sleepDelay":
        return 60 <= value <= NEVER
    return value in (0, NEVER) or (600 <= value <= 2_592_000 and value % 60 == 0)


def _described(preview: tuple[int, int, int]) -> dict[str, int]:
    return dict(zip(("width", "height", "framerate"), preview, strict=True))


def _numbers(firmware: str) -> list[int]:
    return [int(part) for part in firmware.split(".")]
