"""Substitutions of launch files: ``$(var NAME)``, ``$(config FILE)``, ``$(run-dir)`` and ``$(eval EXPRESSION)``.

Nothing is ever executed. An expression compares variables and texts by ``==`` and ``!=``, and combines the results by
``and``, ``or`` and ``not``. The value of a variable is one operand, whatever it looks like.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from simpleeval import InvalidExpression, SimpleEval

from instant_ic.util import paths

MOST_TEXT = 1 << 17
"""Characters of the longest text after substitution; Linux takes no longer argument of a program."""
_MOST_EXPRESSION = 2000
"""Characters of the longest expression."""


class SubstitutionError(ValueError):
    """A substitution cannot be evaluated; the message says which and why."""


@dataclass
class LaunchContext:
    """Values that substitutions refer to.

    Attributes:
        launch_file: the file that contains the text.
        run_dir: run directory of the stack, or of its group.
        variables: values of the arguments and ``let`` entries in scope.
    """

    launch_file: Path
    run_dir: Path
    variables: dict[str, str] = field(default_factory=dict)


def substitute(text: str, context: LaunchContext) -> str:
    """Replace every ``$(...)`` of a text.

    Raises:
        SubstitutionError: a substitution or variable is unknown, a file is missing, an expression is wrong, a
            parenthesis is open, or the result is too long.
    """
    parts: list[str] = []
    position = 0
    while (start := text.find("$(", position)) >= 0:
        end = _closing_parenthesis(text, start + 2)
        parts += [text[position:start], _replacement(text[start + 2 : end], context)]
        position = end + 1
    parts.append(text[position:])
    if sum(map(len, parts)) > MOST_TEXT:  # each of 40 variables may hold its predecessor twice
        raise SubstitutionError(f"the text has more than {MOST_TEXT} characters after substitution")
    return "".join(parts)


def truth(text: str) -> bool:
    """Return the boolean value of a condition's text.

    Raises:
        SubstitutionError: it is neither true or 1 nor false, 0 or empty.
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


def _replacement(body: str, context: LaunchContext) -> str:
    name, _, argument = (part.strip() for part in body.strip().partition(" "))
    if name == "var":
        if argument not in context.variables:
            have = ", ".join(sorted(context.variables)) or "none"
            raise SubstitutionError(f"unknown variable {argument!r} (in scope: {have})")
        return context.variables[argument]
    if name == "config":
        try:
            return str(paths.shipped_file("config", argument))
        except FileNotFoundError as error:
            raise SubstitutionError(str(error)) from None
    if name == "run-dir" and not argument:
        return str(context.run_dir)
    if name == "eval":
        return _evaluated(argument, context.variables)
    raise SubstitutionError(
        f"unknown substitution $({name} ...); supported: $(var NAME), $(config FILE), $(run-dir), $(eval EXPRESSION)"
    )


def _evaluated(expression: str, variables: Mapping[str, str]) -> str:
    """Return the result of an expression as text: ``true``, ``false``, or an operand."""
    if len(expression) > _MOST_EXPRESSION:
        raise SubstitutionError(f"$(eval ...) has more than {_MOST_EXPRESSION} characters")
    evaluator = SimpleEval(operators=_OPERATORS, functions={}, names=dict(variables))
    permitted = (ast.Expr, ast.Name, ast.Constant, ast.Compare, ast.UnaryOp)
    evaluator.nodes = {kind: evaluator.nodes[kind] for kind in permitted}
    evaluator.nodes[ast.BoolOp] = lambda node: _combined(node, evaluator)
    try:
        return _text(evaluator.eval(expression))
    except SyntaxError as error:
        reason = f"{error.msg}; name variables without $(var ...)" if "$(" in expression else error.msg
    except InvalidExpression as error:
        reason = str(error)
    except (SubstitutionError, ValueError, KeyError) as error:
        reason = str(error) if isinstance(error, SubstitutionError) else "only ==, !=, and, or, not are supported"
    except (RecursionError, MemoryError):
        reason = "it is nested too deeply"
    raise SubstitutionError(f"$(eval {expression}): {reason}")


def _combined(node: Any, evaluator: Any) -> bool:
    values = (truth(_text(evaluator._eval(value))) for value in node.values)
    return all(values) if isinstance(node.op, ast.And) else any(values)


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


_OPERATORS: dict[type[ast.AST], Callable[..., bool]] = {
    ast.Eq: lambda left, right: _text(left) == _text(right),
    ast.NotEq: lambda left, right: _text(left) != _text(right),
    ast.Not: lambda value: not truth(_text(value)),
}
"""Operators of ``$(eval ...)``; ``==`` compares texts."""
