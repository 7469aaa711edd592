"""HTML of the participant's pages, and the check of what a browser sends back."""

from __future__ import annotations

import html
import math
import unicodedata
from collections.abc import Mapping
from typing import Any

from instant_ic.experiments.study.plan import Item, Questionnaire

MOST_CHARACTERS = 2000
escape = html.escape


def page(title: str, body: str, refresh_s: int = 0) -> str:
    """A whole page; with ``refresh_s`` it reloads itself."""
    again = f'<meta http-equiv="refresh" content="{refresh_s}">' if refresh_s else ""
    return (
        f'<!doctype html>\n<html><head><meta charset="utf-8">{again}'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{escape(title)}</title><link rel="icon" href="data:,"><link rel="stylesheet" href="/study/page.css">'
        f"</head><body><main>{body}</main></body></html>\n"
    )


def paragraphs(text: str) -> str:
    """Text with empty lines between paragraphs, as HTML."""
    return "".join(f"<p>{escape(' '.join(part.split()))}</p>" for part in text.split("\n\n") if part.strip())


def form(step: str, content: str, *buttons: tuple[str, str]) -> str:
    """A form of a step; buttons are (value, label), the first one is the main one."""
    row = "".join(
        f'<button name="action" value="{escape(value)}"{"" if number else " class=main"}>{escape(label)}</button>'
        for number, (value, label) in enumerate(buttons)
    )
    return (
        f'<form method="post" action="/" autocomplete="off"><input type="hidden" name="step" value="{escape(step)}">'
        f"{content}<p class=buttons>{row}</p></form>"
    )


def questions(
    found: Questionnaire, drives: int, texts: Mapping[str, str], given: Mapping[str, str], faults: Mapping[str, str]
) -> str:
    """Fields of a questionnaire, with the answers given so far and what is wrong with them."""
    parts = [f"<h1>{escape(found.title)}</h1>{paragraphs(found.intro)}"]
    for item in found.items:
        fault = f'<p class=fault role="alert">{escape(texts[faults[item.id]])}</p>' if item.id in faults else ""
        field = _field(item, drives, texts, given.get(item.id, ""))
        focus = " tabindex=-1 autofocus" if item.id == next(iter(faults), "") else ""  # the page scrolls to it
        parts.append(f"<fieldset{focus}><legend>{escape(item.text)}</legend>{fault}{field}</fieldset>")
    return "".join(parts)


def _field(item: Item, drives: int, texts: Mapping[str, str], given: str) -> str:
    name = escape(item.id)
    if item.kind == "text":
        return f'<textarea name="{name}" rows="3" maxlength="{MOST_CHARACTERS}">{escape(given)}</textarea>'
    if item.kind == "number":
        limits = f'min="{item.low:g}" max="{item.high:g}"'
        return f'<input type="number" name="{name}" step="any" {limits} value="{escape(given)}">'
    if item.kind == "scale":
        points = [f"{value:g}" for value in item.points()]
        dots = "".join(
            f'<label title="{value}"><input type="radio" name="{name}" value="{value}"'
            f"{' checked' if value == given else ''}><span>{value if len(points) < 12 else ''}</span></label>"
            for value in points
        )
        left, right = item.ends or ("", "")
        return f"<div class=scale><i>{escape(left)}</i><span class=points>{dots}</span><i>{escape(right)}</i></div>"
    choices = [(text, text) for text in item.options]
    if item.kind == "drive":
        choices = [(str(n), f"{texts['drive_title']} {n}") for n in range(1, drives + 1)] + [("0", texts["none"])]
    return "".join(
        f'<label class=choice><input type="radio" name="{name}" value="{escape(value)}"'
        f"{' checked' if value == given else ''}> {escape(label)}</label>"
        for value, label in choices
    )


def answers(
    found: Questionnaire, drives: int, given: Mapping[str, Any]
) -> tuple[dict[str, float | str | None], dict[str, str]]:
    """Check what a browser sent.

    Args:
        found: the questionnaire.
        drives: number of drives.
        given: fields as sent.

    Returns:
        Answer of each item, None where it was left out; and for each wrong one ``missing`` or ``wrong``.
    """
    right: dict[str, float | str | None] = {}
    faults: dict[str, str] = {}
    for item in found.items:
        raw = given.get(item.id, "")
        text = raw.strip() if isinstance(raw, str) else "\0"
        if not text:
            right[item.id] = None
            if item.required:
                faults[item.id] = "missing"
            continue
        value = _answer(item, drives, text)
        if value is None:
            faults[item.id] = "wrong"
        right[item.id] = value
    return right, faults


def _answer(item: Item, drives: int, text: str) -> float | str | None:
    if item.kind == "text":
        # Format characters are part of Persian and Hindi words, and of emojis; line breaks are kept.
        text = "".join(c for c in text if c == "\n" or unicodedata.category(c) not in ("Cc", "Cs"))
        return text if len(text) <= MOST_CHARACTERS else None
    if item.kind == "choice":
        return text if text in item.options else None
    try:
        value = float(text.replace(",", ".")) if len(text) < 20 else math.nan
    except ValueError:
        return None
    if item.kind == "drive":
        return value if value in range(drives + 1) else None
    if item.kind == "scale":
        return next((point for point in item.points() if math.isclose(point, value)), None)
    return value if item.low <= value <= item.high else None
