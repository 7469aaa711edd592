"""The study as its researcher writes it: ``study.yaml``, checked; and the order of the conditions."""

from __future__ import annotations

import os
import re
import string
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import yaml

from instant_ic.config.params import ParameterError, Value, build
from instant_ic.config.ranges import Range
from instant_ic.config.scalars import to_bool
from instant_ic.config.yaml_text import read_spelled
from instant_ic.util.private import make_folder, open_file

CONDITIONS = ("ic", "stop", "shared", "mesh")
"""Illusory control as shipped; the robot stops at obstacles; it drives around them; illusory control with a scan."""
WHEN = ("before", "drive", "after")
TRUTHS = ("", "driven_m", "ahead_m", "time_s", "longest_stall_s", "contacts")
MOST_PARTICIPANTS = 999
RESERVED = frozenset({"arbiter", "console_port", "params", "record", "recorder", "seed", "vspace_mesh_pose", "world"})
"""Launch arguments that differ between drives."""
T = TypeVar("T")
NAME = r"[a-z][a-z0-9_]{0,30}"
TEMPLATE = Path(__file__).with_name("template.yaml")


class StudyError(ValueError):
    """A study cannot be read, or does not allow what was asked; the text says what is wrong, where and what to do."""


@dataclass(frozen=True)
class Item:
    """One question.

    Attributes:
        id: name of the answer.
        kind: ``drive`` asks for one of the drives, or for none of them.
        text: the question.
        low, high, step: range of ``scale`` and ``number``.
        ends: labels of both ends of a scale.
        options: of a ``choice``.
        reverse: a high answer means a low score.
        required: whether it must be answered.
        truth: for ``number``: the measure that it estimates; empty: none.
    """

    id: str
    kind: Literal["scale", "number", "choice", "drive", "text"]
    text: str
    low: float = 1.0
    high: float = 7.0
    step: Annotated[float, Range(above=0.0)] = 1.0
    ends: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    reverse: bool = False
    required: bool = True
    truth: str = ""

    def points(self) -> list[float]:
        """Values of a scale."""
        return [round(float(x), 6) for x in np.arange(self.low, self.high + self.step / 2, self.step)]


@dataclass(frozen=True)
class Questionnaire:
    """Questions of one page."""

    id: str
    title: str
    when: Literal["before", "drive", "after"]
    intro: str = ""
    score: Literal["mean", "sus", "none"] = "none"
    items: tuple[Item, ...] = ()


@dataclass(frozen=True)
class Study:
    """A study, as in its folder.

    Attributes:
        folder: with ``study.yaml``.
        seed: of orders and starts.
        participants: code → conditions in the order of the drives.
        worlds: one a drive, the same for all participants; drives have different conditions, so none has its own world.
        starts_m: start of each drive along the corridor is drawn from this range, metres.
        goal_m: distance to drive, metres along the start's heading.
        limit_s, practice_s: longest drive and practice, seconds of the stack.
        practice_world: without obstacles.
        arguments: of ``launch/sim.yaml``, the same in all conditions.
        texts: what the participant reads, by name.
        questionnaires: in order.
    """

    seed: Annotated[int, Range(0, 2**31)]
    worlds: tuple[str, ...]
    starts_m: tuple[float, float]
    goal_m: Annotated[float, Range(0.5, 1000)]
    limit_s: Annotated[float, Range(1, 36000)]
    practice_s: Annotated[float, Range(1, 36000)]
    practice_world: str
    folder: Path = Path()
    participants: dict[str, tuple[str, ...]] = field(default_factory=dict)
    arguments: dict[str, Any] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)
    questionnaires: tuple[Questionnaire, ...] = ()

    def steps(self) -> list[str]:
        """Names of the participant's pages in order; none names a condition."""
        before, each, after = ([q.id for q in self.questionnaires if q.when == when] for when in WHEN)
        drives = [name for n in range(1, len(self.worlds) + 1) for name in (f"drive{n}", *(f"{q}.{n}" for q in each))]
        return ["consent", *before, "practice", *drives, *after]

    def questionnaire(self, step: str) -> Questionnaire:
        """Questionnaire of a step."""
        return next(q for q in self.questionnaires if q.id == step.partition(".")[0])

    def start_x_m(self, code: str, drive: int) -> float:
        """Start of a participant's drive (from 1) along the world's x axis."""
        rng = np.random.default_rng([self.seed, drive, *code.encode()])
        return round(float(rng.uniform(*self.starts_m)), 2)


def balanced_square(conditions: int) -> list[list[int]]:
    """Orders in which each condition has each place, and each other before it, equally often (Williams, 1949).

    Args:
        conditions: number of conditions, from 2.

    Returns:
        ``conditions`` orders, or twice as many if the number is odd.
    """
    if conditions < 2:
        raise ValueError(f"a balanced order needs at least 2 conditions (got {conditions})")
    first = [0] + [(k + 1) // 2 if k % 2 else conditions - k // 2 for k in range(1, conditions)]
    rows = [[(place + shift) % conditions for place in first] for shift in range(conditions)]
    return rows if conditions % 2 == 0 else rows + [row[::-1] for row in rows]


def orders(count: int, conditions: Sequence[str], seed: int) -> dict[str, list[str]]:
    """Participant codes and the order of each: whole squares, in random sequence, with randomly assigned letters."""
    rng = np.random.default_rng([89, seed])
    letters = [str(name) for name in rng.permutation(list(conditions))]
    square, rows = balanced_square(len(letters)), list[list[int]]()
    while len(rows) < count:
        rows += [square[row] for row in rng.permutation(len(square))]
    return {f"P{n + 1:02d}": [letters[one] for one in rows[n]] for n in range(count)}


def create(folder: Path, participants: int, seed: int) -> Study:
    """Write the study's folder from the shipped template.

    Raises:
        StudyError: it exists, or the number of participants is out of range.
    """
    if not 1 <= participants <= MOST_PARTICIPANTS:
        raise StudyError(f"--participants must be from 1 to {MOST_PARTICIPANTS} (got {participants})")
    try:
        make_folder(folder)
    except FileExistsError:
        raise StudyError(f"{folder} exists: choose a new folder for the study") from None
    rows = (f"  {code}: [{', '.join(order)}]" for code, order in orders(participants, CONDITIONS, seed).items())
    text = string.Template(TEMPLATE.read_text(encoding="utf-8")).substitute(seed=seed, participants="\n".join(rows))
    save(folder / "study.yaml", text)
    return load(folder)


def save(path: Path, text: str) -> None:
    """Write a file that only its owner can read, atomically, also if the computer goes off."""
    beside = path.with_name(f".{path.name}.new")
    with os.fdopen(open_file(beside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)


def load(folder: Path) -> Study:
    """Read and check a study.

    Raises:
        StudyError: a value is missing or wrong.
    """
    path = folder / "study.yaml"
    try:
        raw = read_spelled(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise StudyError(f"{path} does not exist: create a study with `ic study new {folder}`") from None
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise StudyError(f"{path} cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(raw, dict):
        raise StudyError(f"{path} must be a mapping (got {type(raw).__name__})")
    parts = {key: raw.pop(key, None) for key in ("participants", "arguments", "texts", "questionnaires")}
    for key, value in parts.items():
        if not isinstance(value, wanted := list if key == "questionnaires" else dict):
            what = "list" if wanted is list else "mapping"
            raise StudyError(f"{path}: {key} must be a {what} (got {value!r:.60})")
    for code, order in parts["participants"].items():
        if not isinstance(order, list):
            raise StudyError(f"{path}: participants.{code} must be a list of conditions (got {order!r:.60})")
    study = replace(
        _build(Study, raw, str(path)),
        folder=folder,
        participants={str(code): tuple(map(str, order)) for code, order in parts["participants"].items()},
        arguments={key: _argument(value) for key, value in parts["arguments"].items()},
        texts={str(key): str(value) for key, value in parts["texts"].items()},
        questionnaires=tuple(
            _questionnaire(one, f"{path}: questionnaires[{n}]") for n, one in enumerate(parts["questionnaires"])
        ),
    )
    _check(study, path)
    return study


def _argument(value: Any) -> Any:
    """A launch argument: a truth value, or text in its spelling."""
    with suppress(ValueError):
        return to_bool(value)
    return str(value)


def _build(kind: type[T], raw: Any, where: str) -> T:
    """A dataclass from a mapping of the YAML file."""
    if not isinstance(raw, dict):
        raise StudyError(f"{where} must be a mapping (got {type(raw).__name__})")
    needed = (one.name for one in fields(kind) if one.default is MISSING and one.default_factory is MISSING)  # type: ignore[arg-type]
    if missing := [name for name in needed if name not in raw]:
        raise StudyError(f"{where}: {missing[0]} is missing")
    try:
        return build(kind, {str(key): Value(value, where) for key, value in raw.items()})
    except ParameterError as error:
        raise StudyError(str(error)) from None


def _check(study: Study, path: Path) -> None:
    for code, order in study.participants.items():
        if not re.fullmatch(r"[A-Z][0-9]{2,3}", code):
            raise StudyError(f"{path}: participants.{code}: a code is a letter and two or three digits, never a name")
        if len(order) != len(study.worlds) or not set(order) <= set(CONDITIONS):
            raise StudyError(
                f"{path}: participants.{code} must list {len(study.worlds)} conditions, one a world, of "
                f"{', '.join(CONDITIONS)} (got {', '.join(order)})"
            )
    names = [one.id for one in study.questionnaires]
    if (
        len({*names}) < len(names)
        or {*names} & {"consent", "practice", "withdraw"}
        or any(n.startswith("drive") for n in names)
    ):
        raise StudyError(
            f"{path}: questionnaires: each needs an id of its own, not consent, practice, withdraw or drive..."
        )
    template = string.Template(TEMPLATE.read_text(encoding="utf-8")).substitute(seed=0, participants="  P01: []")
    if missing := sorted(yaml.safe_load(template)["texts"].keys() - study.texts.keys()):
        raise StudyError(f"{path}: texts.{missing[0]} is missing; the template of `ic study new` has it")
    if taken := sorted(study.arguments.keys() & RESERVED):
        raise StudyError(f"{path}: arguments.{taken[0]} is set by the study itself")
    if study.starts_m[0] > study.starts_m[1]:
        raise StudyError(f"{path}: starts_m must be [lowest, highest] (got {list(study.starts_m)})")


def _questionnaire(raw: Any, where: str) -> Questionnaire:
    rows = raw.pop("items", None) if isinstance(raw, dict) else None
    found = _build(Questionnaire, raw, where)
    if not isinstance(rows, list):
        raise StudyError(f"{where}: items must be a list (got {rows!r:.60})")
    items = tuple(_item(one, f"{where}.items[{n}]") for n, one in enumerate(rows))
    if len({one.id for one in items}) < len(items):
        raise StudyError(f"{where}.items: two items have the same id")
    if not re.fullmatch(NAME, found.id):
        raise StudyError(f"{where}: id must be a name of lower-case letters, digits and _ (got {found.id!r})")
    if found.score == "sus" and [(one.low, one.high) for one in items] != [(1.0, 5.0)] * 10:
        raise StudyError(f"{where}: score sus needs ten scales from 1 to 5")
    if found.score != "none" and any(one.kind != "scale" or not one.required for one in items):
        raise StudyError(f"{where}: score {found.score} needs required items of the kind scale only")
    return replace(found, items=items)


def _item(raw: Any, where: str) -> Item:
    item = _build(Item, raw, where)
    if not re.fullmatch(NAME, item.id) or item.id in ("step", "action"):
        raise StudyError(f"{where}: id must be a name of lower-case letters, digits and _, not step or action "
                         f"(got {item.id!r})")  # fmt: skip
    if not item.low < item.high or len(item.ends) not in (0, 2):
        raise StudyError(f"{where}: low must be below high, and ends two texts")
    if item.kind == "scale" and (item.high - item.low) / item.step > 100.5:
        raise StudyError(f"{where}: a scale has at most 101 points")
    if item.kind == "choice" and len(item.options) < 2:
        raise StudyError(f"{where}.options: a choice needs at least two")
    if item.truth not in TRUTHS or (item.truth and item.kind != "number"):
        raise StudyError(f"{where}: truth is for numbers, one of {', '.join(TRUTHS[1:])} (got {item.truth!r})")
    return item
