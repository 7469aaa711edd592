"""Definitions of message types as text, with units and frames of their fields as comments."""

from __future__ import annotations

import functools
import re

import yaml

from instant_ic.msg.types import DEFINITIONS, message_type, type_name, typestore

_ROS_FIELDS = DEFINITIONS.parent / "ros_fields.yaml"
_FIELD = re.compile(r"(?P<type>[A-Za-z][\w/]*)\S*\s+(?P<name>[a-z]\w*)\s*(#.*)?")
_COLUMN = 40
"""Column at which comments start."""


@functools.cache
def ros_fields() -> dict[str, dict[str, str]]:
    """Return unit, frame or meaning of the fields of the ROS 2 types used here, by type and field."""
    comments: dict[str, dict[str, str]] = yaml.safe_load(_ROS_FIELDS.read_text(encoding="utf-8"))
    return comments


def own_types() -> list[str]:
    """Return the full names of the types defined in this project."""
    return sorted(f"{path.parent.name}/msg/{path.stem}" for path in DEFINITIONS.glob("*/*.msg"))


def definition(name: str) -> str:
    """Return the definition of a type, given by full or short name, with comments but without nested types.

    Raises:
        MessageError: there is no such type.
    """
    full = type_name(message_type(name))
    package, _, short = full.split("/")
    path = DEFINITIONS / package / f"{short}.msg"
    if path.is_file():
        return path.read_text(encoding="utf-8").rstrip("\n")
    text = typestore().generate_msgdef(full, ros_version=2)[0].split("=" * 80)[0]
    comments = ros_fields().get(full, {})
    lines = [f"# {comments['about']}"] if "about" in comments else []
    for line in text.splitlines():
        field = _FIELD.fullmatch(line)
        comment = comments.get(field["name"]) if field else None
        lines.append(f"{line:<{_COLUMN - 1}} # {comment}" if comment else line)
    return "\n".join(lines)


def expanded_definition(name: str) -> str:
    """Return the definition of a type, with the fields of nested types indented below each field, without comments.

    Raises:
        MessageError: there is no such type.
    """
    lines: list[str] = []
    nested = ""
    for line in definition(name).splitlines():
        # Indented lines continue the comment of the field above, so nested fields are inserted after them.
        if not line[:1].isspace():
            lines += _nested(nested)
            field = _FIELD.fullmatch(line)
            nested = field["type"] if field and "/" in field["type"] else ""
        lines.append(line)
    return "\n".join(lines + _nested(nested))


def _nested(name: str) -> list[str]:
    if not name:
        return []
    lines = (line.split("#")[0].rstrip() for line in expanded_definition(name).splitlines())
    return [f"\t{line}" for line in lines if line]
