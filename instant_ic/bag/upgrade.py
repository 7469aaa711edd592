"""Conversion of messages recorded with an older definition of their type."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from instant_ic.bag.message import Schema
from instant_ic.bag.metadata import schema_or_unknown, store_of
from instant_ic.msg import message_type, serialize, typestore

_DEFAULTS: dict[str, bool | float | str] = {"bool": False, "string": "", **dict.fromkeys(("float32", "float64"), 0.0)}
_INTEGERS = tuple(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))


@functools.lru_cache(maxsize=200)
def upgrade_of(schema: Schema) -> Callable[[bytes], bytes] | None:
    """Return a function that converts payloads of ``schema`` to the present definition; None if that is impossible.

    Numbers, booleans and strings may have been added at the end of the type; they get 0, False or "". Fields may also
    have been removed at its end. Any other difference could change the meaning of a field, so it is not converted.
    """
    own = schema_or_unknown(schema.name)
    if not own.encoding or schema.encoding != "ros2msg" or schema.type_hash in ("", own.type_hash):
        return None
    try:
        store = store_of(schema)
        before, now = (list(types.get_msgdef(schema.name).fields) for types in (store, typestore()))
    except Exception:  # noqa: BLE001 - a parser may raise anything on a damaged definition
        return None
    added = {name: _default(kind) for name, kind in now[len(before) :]}
    nested = (name for name in store.fielddefs if name != schema.name)
    kept = min(len(before), len(now))
    unchanged = before[:kept] == now[:kept] and all(_same(store, name) for name in nested)
    if not unchanged or None in added.values():
        return None
    message_class = message_type(schema.name)

    def upgrade(payload: bytes) -> bytes:
        message = store.deserialize_cdr(payload, schema.name)
        fields = {name: getattr(message, name) for name, _ in before[:kept]}
        return bytes(serialize(message_class(**fields, **added)))

    return upgrade


def _default(kind: Any) -> bool | float | str | None:
    """Return the value of an added field; None where the type has no plain default."""
    name = kind[1][0] if isinstance(kind[1], tuple) else None
    return 0 if name in _INTEGERS else _DEFAULTS.get(str(name))


def _same(store: Any, name: str) -> bool:
    known = typestore().fielddefs
    return name in known and bool(known[name][1] == store.fielddefs[name][1])
