"""One self-contained HTML page, and its JSON, from the sections of experiments."""

from __future__ import annotations

import base64
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

from jinja2 import Environment, PackageLoader, StrictUndefined

from instant_ic.experiments.lab import Result
from instant_ic.experiments.results import finite, save_json, save_text


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Table:
    """Rows of text and numbers; a number may be a list, which is shown as its mean and standard deviation."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    command: str = ""


@dataclass(frozen=True)
class Figure:
    """Plots as SVG text, or the ``data:`` address of an image."""

    caption: str
    source: str
    command: str = ""
    wide: bool = False
    """True if it needs scrolling on a phone."""


Part: TypeAlias = Text | Table | Figure

PAPER = {
    "straight": "V.A: straight ahead, instant IC is above conventional IC in SSIM for about the first 2 m",
    "curve": "V.A: on a curve, it is above for 1 to 2 m",
    "training": "V.B: the view converges in 3 to 4 s of training on a GPU",
    "depth": "V.C: the depth prior improves the view",
    "scaling": "V.C: scaling the depth by the LiDAR improves the view",
    "flow": "V.D: the flow r to v to r works without a model made beforehand",
    "people": "V.E: people prefer neither instant nor conventional IC (three to two, two to two)",
    "places": "V.F: corridors are shown well; open places, windows and crossing corridors are not always",
}
"""Claims of the paper."""
LEAST_UNITS = 3


@dataclass(frozen=True)
class Answer:
    """Answer to a claim of the paper.

    Attributes:
        held: True if the claim holds here; None if it was not measured.
        figures: figures that decide it.
        units: number of measurements behind it; the report decides nothing from fewer than ``LEAST_UNITS``.
    """

    held: bool | None
    figures: str
    units: int = 0


@dataclass(frozen=True)
class Section:
    """One experiment.

    Attributes:
        title: heading of the section.
        parts: paragraphs, tables and figures.
        answers: answers to claims of ``PAPER``, by the claim's key.
    """

    title: str
    parts: Sequence[Part]
    answers: dict[str, Answer] = field(default_factory=dict)


def spread(values: Sequence[float | None], digits: int = 2) -> str:
    """Format the mean ± standard deviation of the known values, or a single value with (1)."""
    known = [value for value in values if value is not None]
    if not known:
        return "–"
    mean = f"{statistics.fmean(known):.{digits}f}"
    return f"{mean} ± {statistics.stdev(known):.{digits}f}" if len(known) > 1 else f"{mean} (1)"


def image_address(jpeg_or_other: bytes, kind: str = "image/jpeg") -> str:
    """Return an image as a ``data:`` address for a page."""
    return f"data:{kind};base64,{base64.b64encode(jpeg_or_other).decode()}"


def answers(sections: dict[str, Section]) -> dict[str, Answer]:
    """Return the answer to each claim of ``PAPER``."""
    found = {key: _decided(answer) for section in sections.values() for key, answer in section.answers.items()}
    none = Answer(None, "")
    return {key: found.get(key, none) for key in PAPER} | {"people": Answer(None, "it takes people: ic study")}


def _decided(answer: Answer) -> Answer:
    if answer.held is None or answer.units >= LEAST_UNITS:
        return answer
    return replace(answer, held=None, figures=f"{answer.figures}; too few to decide: {answer.units} units")


def write(folder: Path, sections: dict[str, Section], results: Sequence[Result], conditions: dict[str, Any]) -> None:
    """Write ``report.html`` and ``report.json``.

    Args:
        folder: existing folder.
        sections: sections by name.
        results: results of the experiments' units.
        conditions: machine, versions, command and times.
    """
    claims = {key: {"claim": PAPER[key], **vars(one)} for key, one in answers(sections).items()}
    pages = Environment(loader=PackageLoader(__package__, "."), autoescape=True, undefined=StrictUndefined)
    page = pages.get_template("report.html").render(
        sections=sections, claims=claims, results=results, conditions=conditions, number=_number
    )
    save_text(folder / "report.html", page)
    tables = {
        name: [vars(part) for part in section.parts if isinstance(part, Table)] for name, section in sections.items()
    }
    units = [
        {
            "experiment": one.unit.experiment,
            "arguments": one.unit.arguments,
            "wall_s": one.wall_s,
            "cpu_s": one.cpu_s,
            "error": one.error,
            **{key: value for key, value in one.data.items() if key != "images"},
        }
        for one in results
    ]
    known = {"conditions": conditions, "paper": claims, "tables": tables, "units": units}
    save_json(folder / "report.json", finite(known, 5))


def _number(value: Any) -> str:
    """Format a number, or the mean and standard deviation of a list; precision follows the largest value."""
    if isinstance(value, list):
        known = [abs(one) for one in value if one is not None]
        return spread(value, 3 if known and max(known) <= 1 else 2 if known and max(known) < 100 else 0)
    if isinstance(value, float):
        return f"{value:.3g}"
    return "–" if value is None else str(value)
