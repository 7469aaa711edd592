"""``$(var x)``, ``$(env X default)``, ``$(config file.yaml)`` and the like in launch files.

Nothing is ever executed: ``$(eval ...)`` knows ``==``, ``!=``, ``and``, ``or``, ``not`` and parentheses, and a nested
substitution is one operand of it, whatever its value looks like.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from instant_ic import paths

TRUE_WORDS = ("true", "1")
FALSE_WORDS = ("false", "0", "")

_TOKEN = re.compile(r"\s*(?:(==|!=|\(|\))|'([^']*)'|\"([^\"]*)\"|([^\s()=!'\"]+))")
_VARIABLE = re.compile(r"\w+")


class SubstitutionError(ValueError):
    """A substitution that cannot be worked out; the message says which and why."""


@dataclass
class Context:
    """What substitutions refer to.

    Attributes:
        launch_file: the file that the text stands in.
        run_dir: run directory of the stack.
        variables: launch arguments and ``let`` values in scope.
        environment: environment variables.
    """

    launch_file: Path
    run_dir: Path
    variables: dict[str, str] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=lambda: dict(os.environ))

    def child(self) -> Context:
        """A copy whose variables can change without changing these (a group's scope)."""
        return Context(self.launch_file, self.run_dir, dict(self.variables), self.environment)


def substitute(text: str, context: Context) -> str:
    """``text`` with every ``$(...)`` replaced.

    Raises:
        SubstitutionError: unknown substitution or variable, unset environment variable without default, a
            missing file, an unclosed parenthesis.
    """
    parts: list[str] = []
    position = 0
    while (start := text.find("$(", position)) >= 0:
        parts.append(text[position:start])
        end = _matching_parenthesis(text, start + 2)
        parts.append(_evaluate(text[start + 2 : end], context))
        position = end + 1
    parts.append(text[position:])
    return "".join(parts)


def has_substitution(text: str) -> bool:
    """Whether ``substitute`` would change anything."""
    return "$(" in text


def truth(text: str) -> bool:
    """The truth value of a condition's text.

    Raises:
        SubstitutionError: neither true/1 nor false/0/empty.
    """
    word = text.strip().lower()
    if word in TRUE_WORDS:
        return True
    if word in FALSE_WORDS:
        return False
    raise SubstitutionError(f"a condition must be true or false, got {text!r}")


def _matching_parenthesis(text: str, position: int) -> int:
    depth = 1
    for index in range(position, len(text)):
        if text[index] == "(":
            depth += 1
        elif text[index] == ")":
            depth -= 1
            if depth == 0:
                return index
    raise SubstitutionError(f"unclosed $( in {text!r}")


def _evaluate(body: str, context: Context) -> str:
    name, _, rest = body.strip().partition(" ")
    if name == "eval":
        return "true" if _Expression(rest, context).value() else "false"
    words = substitute(rest, context).split()

    def one_word(what: str) -> str:
        if len(words) != 1:
            raise SubstitutionError(f"$({name} ...) takes one {what}, got {rest.strip()!r}")
        return words[0]

    match name:
        case "var":
            variable = one_word("name")
            if variable not in context.variables:
                have = ", ".join(sorted(context.variables)) or "none"
                raise SubstitutionError(f"unknown variable {variable!r} (in scope: {have})")
            return context.variables[variable]
        case "env":
            if not words:
                raise SubstitutionError("$(env NAME default) needs a name")
            if words[0] in context.environment:
                return context.environment[words[0]]
            if len(words) == 1 and not rest.endswith(" "):
                raise SubstitutionError(f"environment variable {words[0]} is not set and has no default")
            return " ".join(words[1:])
        case "config":
            return str(_file_in("config", one_word("file name")))
        case "launch-file":
            return str(_file_in("launch", words[0])) if words else str(context.launch_file)
        case "dirname":
            return str(context.launch_file.parent)
        case "run-dir":
            return str(context.run_dir)
    known = "var, env, config, launch-file, dirname, run-dir, eval"
    raise SubstitutionError(f"unknown substitution $({name} ...); there are {known}")


def _file_in(folder: str, name: str) -> Path:
    try:
        return paths.shipped_file(folder, name)
    except FileNotFoundError as error:
        raise SubstitutionError(str(error)) from None


class _Expression:
    """Recursive descent over: or := and ('or' and)*; and := not ('and' not)*; not := 'not' not | comparison."""

    def __init__(self, text: str, context: Context) -> None:
        self.text = text
        self.tokens = list(self._tokens(text, context))
        self.position = 0

    def value(self) -> bool:
        result = self._or()
        if self.position < len(self.tokens):
            raise SubstitutionError(f"$(eval {self.text}): unexpected {self.tokens[self.position][1]!r}")
        return result

    def _tokens(self, text: str, context: Context) -> list[tuple[str, str]]:
        tokens: list[tuple[str, str]] = []
        position = 0
        while text[position:].strip():
            rest = text[position:]
            if rest.lstrip().startswith("$("):
                start = position + len(rest) - len(rest.lstrip())
                end = _matching_parenthesis(text, start + 2)
                tokens.append(("operand", _evaluate(text[start + 2 : end], context)))
                position = end + 1
                continue
            match = _TOKEN.match(text, position)
            if match is None:
                raise SubstitutionError(f"$(eval {text}): cannot read {rest.strip()!r}")
            symbol, single, double, word = match.groups()
            if symbol is not None:
                tokens.append(("symbol", symbol))
            elif word is None:
                quoted = single if single is not None else double
                # A quoted operand may hold substitutions; their value is text, never operators.
                tokens.append(("operand", substitute(quoted, context)))
            elif word in ("and", "or", "not"):
                tokens.append(("symbol", word))
            elif _VARIABLE.fullmatch(word) and word in context.variables:
                tokens.append(("operand", context.variables[word]))
            else:
                tokens.append(("operand", word))
            position = match.end()
        return tokens

    def _take(self, symbol: str) -> bool:
        if self.position < len(self.tokens) and self.tokens[self.position] == ("symbol", symbol):
            self.position += 1
            return True
        return False

    def _or(self) -> bool:
        result = self._and()
        while self._take("or"):
            right = self._and()
            result = result or right
        return result

    def _and(self) -> bool:
        result = self._not()
        while self._take("and"):
            right = self._not()
            result = result and right
        return result

    def _not(self) -> bool:
        if self._take("not"):
            return not self._not()
        if self._take("("):
            result = self._or()
            if not self._take(")"):
                raise SubstitutionError(f"$(eval {self.text}): a ) is missing")
            return result
        left = self._operand()
        if self._take("=="):
            return left == self._operand()
        if self._take("!="):
            return left != self._operand()
        return truth(left)

    def _operand(self) -> str:
        if self.position < len(self.tokens) and self.tokens[self.position][0] == "operand":
            self.position += 1
            return self.tokens[self.position - 1][1]
        raise SubstitutionError(f"$(eval {self.text}): an operand is missing")
