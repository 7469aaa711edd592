"""One self-contained HTML page, and its JSON, from the sections of experiments."""

from __future__ import annotations

import base64
import html
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

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
    """Plots as SVG text, or the ``data:`` address of an image or film."""

    caption: str
    source: str
    command: str = ""
    wide: bool = False
    """Whether it needs scrolling on a phone."""


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
_MARKS = {True: ("yes", "holds"), False: ("no", "does not hold"), None: ("", "not measured")}
_LONG_TEXT = 40
"""More characters wrap, as a participant's answer."""
LEAST_UNITS = 3


@dataclass(frozen=True)
class Answer:
    """Whether a claim of the paper holds here, None where it was not measured, and the figures that decide it.

    ``units`` is the number of measurements behind it; the report decides nothing from less than ``LEAST_UNITS``.
    """

    held: bool | None
    figures: str
    units: int = 0


@dataclass(frozen=True)
class Section:
    """One experiment.

    Attributes:
        verdict: sentence → whether it holds; None: not measured.
        answers: claim of ``PAPER`` → whether it holds, from the results.
    """

    title: str
    parts: Sequence[Part]
    verdict: dict[str, bool | None] = field(default_factory=dict)
    answers: dict[str, Answer] = field(default_factory=dict)


def spread(values: Sequence[float | None], digits: int = 2) -> str:
    """Mean ± standard deviation of what is known, and the number of values where it is one."""
    known = [value for value in values if value is not None]
    if not known:
        return "–"
    mean = f"{statistics.fmean(known):.{digits}f}"
    return f"{mean} ± {statistics.stdev(known):.{digits}f}" if len(known) > 1 else f"{mean} (1)"


def image_address(jpeg_or_other: bytes, kind: str = "image/jpeg") -> str:
    """Bytes of an image as an address for a page."""
    return f"data:{kind};base64,{base64.b64encode(jpeg_or_other).decode()}"


def answers(sections: dict[str, Section]) -> dict[str, Answer]:
    """Answer to each claim of ``PAPER``."""
    found = {key: _decided(answer) for section in sections.values() for key, answer in section.answers.items()}
    none = Answer(None, "")
    return {key: found.get(key, none) for key in PAPER} | {"people": Answer(None, "it takes people: ic study")}


def _decided(answer: Answer) -> Answer:
    if answer.held is None or answer.units >= LEAST_UNITS:
        return answer
    return replace(answer, held=None, figures=f"{answer.figures}; too few to decide: {answer.units} units")


def _claims(sections: dict[str, Section]) -> dict[str, dict[str, Any]]:
    return {key: {"claim": PAPER[key], **vars(one)} for key, one in answers(sections).items()}


def write(
    folder: Path,
    sections: dict[str, Section],
    results: Sequence[Result],
    conditions: dict[str, Any],
    title: str = "",
    more: dict[str, Any] | None = None,
) -> None:
    """Write ``report.html`` and ``report.json``.

    Args:
        folder: existing.
        sections: by name.
        results: of the experiments' units; empty for a report without units.
        conditions: machine, versions, command and times.
        title: of the page; empty for the paper's experiments, whose claims are answered.
        more: further entries of the JSON.
    """
    save_text(folder / "report.html", _page(title, sections, results, conditions))
    save_json(
        folder / "report.json",
        finite(
            {
                **(more or {}),
                "conditions": conditions,
                **({} if title else {"paper": _claims(sections)}),
                "verdict": {name: section.verdict for name, section in sections.items()},
                "tables": {
                    name: [vars(part) for part in section.parts if isinstance(part, Table)]
                    for name, section in sections.items()
                },
                "units": [
                    {
                        "experiment": one.unit.experiment,
                        "arguments": one.unit.arguments,
                        "wall_s": one.wall_s,
                        "cpu_s": one.cpu_s,
                        "error": one.error,
                        **{key: value for key, value in one.data.items() if key != "images"},
                    }
                    for one in results
                ],
            },
            5,
        ),
    )


_STYLE = """
:root { color-scheme: light dark; --ink: #1c2128; --paper: #fff; --line: #d4d9df; --soft: #f3f5f7; --good: #0b6e3b;
  --bad: #a8321f; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ec; --paper: #14181d; --line: #3a424c; --soft: #1e242b;
  --good: #5fd394; --bad: #ff9b85; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem; max-width: 62rem; color: var(--ink); background: var(--paper);
  font: 16px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.5rem; line-height: 1.2; } h2 { margin-top: 2.5rem; border-top: 1px solid var(--line);
  padding-top: 1rem; font-size: 1.25rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
h3 { font-size: .95rem; margin: 1.4rem 0 .3rem; }
th, td { padding: .25rem .6rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
td.text { text-align: left; }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: var(--paper);
  white-space: normal; min-width: 6rem; max-width: 42vw; }
td.long { white-space: pre-line; } td + td.long { min-width: 14rem; }
figure { margin: 0; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); gap: .5rem; }
.plots svg { width: 100%; height: auto; }
img { width: 100%; } .strip { min-width: 44rem; }
code { display: block; overflow-x: auto; background: var(--soft); padding: .3rem .5rem; font-size: .78rem;
  margin: .3rem 0 1.2rem; white-space: pre; }
.yes { color: var(--good); } .no { color: var(--bad); } nav { display: flex; flex-wrap: wrap; gap: 0 1rem; }
dl { display: grid; grid-template-columns: auto 1fr; gap: 0 1rem; font-size: .85rem; }
dd { margin: 0; overflow-wrap: anywhere; }
a { color: inherit; }
"""


def _page(title: str, sections: dict[str, Section], results: Sequence[Result], conditions: dict[str, Any]) -> str:
    links = "".join(f'<a href="#{name}">{html.escape(name)}</a>' for name in sections)
    bodies = "".join(_section(name, section, results) for name, section in sections.items())
    seeds = "" if title else f"<p>Numbers are mean ± standard deviation over the seeds.</p>{_answers(sections)}"
    title = title or "Instant IC: the paper's experiments"
    facts = "".join(f"<dt>{html.escape(k)}</dt><dd>{html.escape(str(v))}</dd>" for k, v in conditions.items())
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>"
        f"<h1>{html.escape(title)}</h1><nav>{links}</nav>{seeds}{bodies}"
        f"<h2>Conditions</h2><dl>{facts}</dl></body></html>\n"
    )


def _answers(sections: dict[str, Section]) -> str:
    rows = "".join(
        f"<li>{html.escape(PAPER[key])}: {_mark(one.held)}{'; ' if one.figures else ''}{html.escape(one.figures)}.</li>"
        for key, one in answers(sections).items()
    )
    return f"<h2>Claims of the paper</h2><ul>{rows}</ul>"


def _mark(held: bool | None) -> str:
    look, text = _MARKS[held]
    return f'<b class="{look}">{text}</b>'


def _section(name: str, section: Section, results: Sequence[Result]) -> str:
    own = [one for one in results if one.unit.experiment == name]
    parts = [f'<h2 id="{name}">{html.escape(section.title)}</h2>']
    if section.verdict:
        rows = "".join(f"<li>{html.escape(text)}: {_mark(held)}</li>" for text, held in section.verdict.items())
        parts.append(f"<ul>{rows}</ul>")
    parts += [_part(part) for part in section.parts]
    failed = [one for one in own if one.error]
    if failed:
        rows = "".join(
            f"<li>{html.escape(one.unit.place)}, {html.escape(str(one.unit.arguments))}: {html.escape(one.error)}</li>"
            for one in failed
        )
        parts.append(f"<details><summary>{len(failed)} of {len(own)} units failed</summary><ul>{rows}</ul></details>")
    if not results:
        return "".join(parts)
    wall, cpu = (sum(getattr(one, key) for one in own) for key in ("wall_s", "cpu_s"))
    parts.append(f"<p>{len(own)} units, {wall:.0f} s of wall time of all together, {cpu:.0f} s of CPU time.</p>")
    return "".join(parts)


def _part(part: Part) -> str:
    if isinstance(part, Text):
        return f"<p>{html.escape(part.text)}</p>"
    command = f"<code>{html.escape(part.command)}</code>" if part.command else ""
    caption = html.escape(part.caption)
    if isinstance(part, Figure):
        if part.source.startswith("data:"):
            kind = "strip" if part.wide else "whole"
            body = f'<div class="wide"><img class="{kind}" src="{part.source}" alt="{caption}"></div>'
        else:
            body = f'<div class="plots">{part.source}</div>'
        return f"<h3>{caption}</h3><figure>{body}</figure>{command}"
    head = "".join(f"<th>{html.escape(str(column))}</th>" for column in part.columns)
    rows = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in part.rows)
    return f'<h3>{caption}</h3><div class="wide"><table><tr>{head}</tr>{rows}</table></div>{command}'


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return f'<td class="{"text long" if len(value) > _LONG_TEXT else "text"}">{html.escape(value)}</td>'
    return f"<td>{_number(value)}</td>"


def _number(value: Any) -> str:
    if isinstance(value, list):
        known = [abs(one) for one in value if one is not None]
        return spread(value, 3 if known and max(known) <= 1 else 2 if known and max(known) < 100 else 0)
    if isinstance(value, float):
        return f"{value:.3g}"
    return "–" if value is None else html.escape(str(value))
