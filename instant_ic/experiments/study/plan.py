"""The plan of a user study, the balanced order of its conditions, and the record of a participant."""

from __future__ import annotations

import itertools
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml

from instant_ic.config.params import ParameterError, Value, build
from instant_ic.config.ranges import Range
from instant_ic.experiments.results import finite, save_json
from instant_ic.util.private import make_folder

CONDITIONS = ("ic", "mesh", "stop")
"""Illusory control as shipped; illusory control in a scan made beforehand; a robot that stops at obstacles."""
QUESTIONS = {
    "appearance": "Which drive had the more realistic appearance?",
    "usability": "Which drive was easier to operate?",
}
"""The paper's questions (V.E); each is answered with the number of a drive, or 0 for no difference."""
MAX_TEXT = 2000
"""Longest free text, characters."""


class StudyError(ValueError):
    """A study cannot be read or continued; the text says what is wrong, where and what to do."""


@dataclass(frozen=True)
class StudyPlan:
    """The settings of a study: ``study.yaml`` in its folder.

    Attributes:
        participants: number of participants, best a multiple of 6, the number of possible orders.
        seed: seed of the orders and of all simulated noise.
        worlds: one simulated world a drive, the same for all participants.
        goal_m: distance to drive along the start's heading, metres.
        limit_s: longest drive, seconds of the stack.
    """

    participants: Annotated[int, Range(1, 999)] = 12
    seed: Annotated[int, Range(0, 2**31)] = 0
    worlds: tuple[str, ...] = ("corridor:1", "corridor:2", "corridor:3")
    goal_m: Annotated[float, Range(0.5, 1000)] = 7.0
    limit_s: Annotated[float, Range(1, 36000)] = 180.0

    def __post_init__(self) -> None:
        if len(self.worlds) != len(CONDITIONS):
            raise ValueError(f"worlds must be {len(CONDITIONS)}, one a condition (got {len(self.worlds)})")

    def orders(self) -> dict[str, tuple[str, ...]]:
        """Return the order of the conditions by participant code; each six participants have all orders once."""
        rng = np.random.default_rng([89, self.seed])
        every = list(itertools.permutations(CONDITIONS))
        blocks = (rng.permutation(len(every)) for _ in range(-(-self.participants // len(every))))
        rows = [every[row] for block in blocks for row in block]
        return {f"P{number + 1:02d}": rows[number] for number in range(self.participants)}


def create(folder: Path, plan: StudyPlan) -> None:
    """Write the folder of a new study, which only its owner can read.

    Raises:
        StudyError: the folder exists.
    """
    try:
        make_folder(folder)
    except FileExistsError:
        raise StudyError(f"{folder} exists: choose a new folder for the study") from None
    values = asdict(plan) | {"worlds": list(plan.worlds)}
    (folder / "study.yaml").write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")


def load(folder: Path) -> StudyPlan:
    """Read and check the plan of a study.

    Raises:
        StudyError: the file is missing, is not YAML, or a value is wrong.
    """
    path = folder / "study.yaml"
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise StudyError(f"{path} cannot be read: {error}. Create a study with `ic study new {folder}`") from None
    if not isinstance(values, dict):
        raise StudyError(f"{path} must be a mapping (got {type(values).__name__})")
    try:
        return build(StudyPlan, {str(key): Value(value, str(path)) for key, value in values.items()})
    except ParameterError as error:
        raise StudyError(str(error)) from None


@dataclass
class Participant:
    """The record of a participant, in ``participants/CODE/answers.json``; no name, no address.

    Attributes:
        folder: folder of the participant, with one bag a drive.
        order: condition of each drive.
        drives: measures of each finished drive, in their order.
        answers: answers to ``QUESTIONS``, and ``text``; empty before the last page.
    """

    folder: Path
    order: tuple[str, ...]
    drives: list[dict[str, Any]] = field(default_factory=list)
    answers: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def load(cls, study: Path, plan: StudyPlan, code: str) -> Participant:
        """Return a participant up to the last finished page.

        Raises:
            StudyError: the study has no such code, or the file is damaged.
        """
        orders = plan.orders()
        if code not in orders:
            raise StudyError(f"{study}: there is no participant {code!r}; the codes are P01 to {list(orders)[-1]}")
        found = cls(study / "participants" / code, orders[code])
        path = found.folder / "answers.json"
        if path.exists():
            try:
                kept = json.loads(path.read_text(encoding="utf-8"))
                found.order = tuple(kept["order"])
                found.drives, found.answers = list(kept["drives"]), dict(kept["answers"])
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise StudyError(f"{path} is damaged ({error}): restore it or delete {found.folder}") from None
        return found

    def save(self) -> None:
        """Write the file."""
        make_folder(self.folder, exist_ok=True)
        kept = {"order": list(self.order), "drives": self.drives, "answers": self.answers}
        save_json(self.folder / "answers.json", finite(kept))
