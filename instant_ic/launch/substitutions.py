"""Substitutions of launch files: ``$(var NAME)``, ``$(config FILE)``, ``$(run-dir)`` and ``$(eval EXPRESSION)``.

No code is executed: ``simpleeval`` computes the expressions, without functions. A variable in an expression is a single
operand, whatever its text.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from simpleeval import SimpleEval

from instant_ic.util import paths


class SubstitutionError(ValueError):
    """A substitution cannot be evaluated; the message names it and gives the reason."""


def substitute(text: str, variables: Mapping[str, str], run_dir: Path) -> str:
    """Replace every ``$(...)`` of a text.

    Args:
        text: the text.
        variables: values of the arguments and ``let`` entries in scope.
        run_dir: run directory of the stack, or of its group.

    Raises:
        SubstitutionError: a substitution or variable is unknown, a file is missing, an expression is wrong, or a
            parenthesis is not closed.
    """
    parts: list[str] = []
    position = 0
    while (start := text.find("$(", position)) >= 0:
        end = _closing_parenthesis(text, start + 2)
        parts += [text[position:start], _replacement(text[start + 2 : end], variables, run_dir)]
        position = end + 1
    parts.append(text[position:])
    return "".join(parts)


def truth(text: str) -> bool:
    """Return the boolean value of a condition's text.

    Raises:
        SubstitutionError: the text is none of true, 1, false, 0 and empty.
    """
    word = text.strip().lower()
    if word in ("true", "1"):
        return True
    if word in ("false", "0", ""):
        return False
    raise SubstitutionError(f"a condition must be true or false, got {text!r}")


def _closing_parenthesis(text: str, position: int) -> int:
    depth = 1
    for index in range(position, len(text)):
        depth += {"(": 1, ")": -1}.get(text[index], 0)
        if depth == 0:
            return index
    raise SubstitutionError(f"unclosed $( in {text!r}")


def _replacement(body: str, variables: Mapping[str, str], run_dir: Path) -> str:
    name, _, argument = (part.strip() for part in body.strip().partition(" "))
    if name == "var":
        if argument not in variables:
            have = ", ".join(sorted(variables)) or "none"
            raise SubstitutionError(f"unknown variable {argument!r} (in scope: {have})")
        return variables[argument]
    if name == "config":
        try:
            return str(paths.shipped_file("config", argument))
        except FileNotFoundError as error:
            raise SubstitutionError(str(error)) from None
    if name == "run-dir" and not argument:
        return str(run_dir)
    if name == "eval":
        return _evaluated(argument, variables)
    raise SubstitutionError(
        f"unknown substitution $({name} ...); supported: $(var NAME), $(config FILE), $(run-dir), $(eval EXPRESSION)"
    )


class _Variable(str):
    """A variable in an expression. It compares as text, and its truth value is that of its text."""

    __slots__ = ()
    __hash__ = str.__hash__

    def __bool__(self) -> bool:
        return truth(self)

    def __eq__(self, other: object) -> bool:
        return str(self) == _text(other)

    def __ne__(self, other: object) -> bool:
        return not self == other


def _evaluated(expression: str, variables: Mapping[str, str]) -> str:
    """Return the result of an expression as text."""
    names = {"true": True, "false": False, **{name: _Variable(value) for name, value in variables.items()}}
    try:
        return _text(SimpleEval(functions={}, names=names).eval(expression))
    except Exception as error:  # noqa: BLE001 - operators raise any kind of error for unsuitable operands
        hint = "; name variables without $(var ...)" if "$(" in expression else ""
        raise SubstitutionError(f"$(eval {expression}): {error}{hint}") from None


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
