"""Substitutions of launch files: ``$(var x)``, ``$(env X default)``, ``$(config file.yaml)`` and others.

Nothing is ever executed. ``$(eval ...)`` knows comparisons, ``and``, ``or``, ``not`` and parentheses; a nested
substitution is always one operand, whatever its value looks like.
"""

from __future__ import annotations

import itertools
import operator
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from instant_ic.util import paths

TRUE_WORDS = ("true", "1")
FALSE_WORDS = ("false", "0", "")

_TOKEN = re.compile(r"\s*(?:(==|!=|<=|>=|<|>|\(|\))|'([^']*)'|\"([^\"]*)\"|([^\s()=!<>'\"]+))")
_VARIABLE = re.compile(r"\w+")
_ORDER: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_KNOWN = (
    "var, env, config, launch-file, dirname, filename, run-dir, find-pkg-share, find-exec, anon, eval, equals, "
    "not-equals, not, and, or, if"
)
_NOT_HERE = {
    "command": "nothing is executed while a launch file is read",
    "find-pkg-prefix": "$(find-pkg-share instant_ic) is the folder that holds launch/ and config/",
    "exec-in-pkg": "give the program's path, or $(find-exec NAME)",
    "optenv": "use $(env NAME default)",
}
MOST_TEXT = 1 << 17
"""Most characters after substitution; Linux takes no longer argument of a program."""
_anonymous = itertools.count(1)


class SubstitutionError(ValueError):
    """A substitution cannot be evaluated; the message says which and why."""


@dataclass
class Context:
    """What substitutions refer to.

    Attributes:
        launch_file: the file that contains the text.
        run_dir: run directory of the stack.
        variables: launch arguments and ``let`` values in scope.
    """

    launch_file: Path
    run_dir: Path
    variables: dict[str, str] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=lambda: dict(os.environ))

    def child(self) -> Context:
        """A copy whose variables and environment can change independently (a group's scope)."""
        return Context(self.launch_file, self.run_dir, dict(self.variables), dict(self.environment))


def substitute(text: str, context: Context) -> str:
    r"""``text`` with every ``$(...)`` replaced; ``\$(`` stands for ``$(`` itself.

    Raises:
        SubstitutionError: unknown substitution or variable, unset environment variable without default, a
            missing file, an unclosed parenthesis, or too long a result.
    """
    parts: list[str] = []
    position = 0
    while (start := text.find("$(", position)) >= 0:
        if start > position and text[start - 1] == "\\":  # a program's own $(...)
            parts.append(text[position : start - 1] + "$(")
            position = start + 2
            continue
        parts.append(text[position:start])
        end = _matching_parenthesis(text, start + 2)
        parts.append(_evaluate(text[start + 2 : end], context))
        position = end + 1
    parts.append(text[position:])
    if sum(map(len, parts)) > MOST_TEXT:  # each of 40 variables may hold its predecessor twice
        raise SubstitutionError(f"the text has more than {MOST_TEXT} characters after substitution")
    return "".join(parts)


def has_substitution(text: str) -> bool:
    """Whether ``substitute`` would change anything."""
    return "$(" in text


def truth(text: str) -> bool:
    """Boolean value of a condition's text.

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
        return _word(_Expression(_unwrapped(rest.strip()), context).value())
    words = _arguments(rest, context)

    def exactly(count: int, what: str) -> list[str]:
        if len(words) != count:
            raise SubstitutionError(f"$({name} ...) takes {what}, got {rest.strip()!r}")
        return words

    match name:
        case "var":
            [variable] = exactly(1, "one name")
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
            return str(_file_in("config", exactly(1, "one file name")[0]))
        case "launch-file":
            return str(_file_in("launch", words[0])) if words else str(context.launch_file)
        case "filename":
            return str(context.launch_file)
        case "dirname":
            return str(context.launch_file.parent)
        case "run-dir":
            return str(context.run_dir)
        case "find-pkg-share":
            [package] = exactly(1, "one package")
            if package != "instant_ic":
                raise SubstitutionError(f"package {package!r}: only instant_ic has a share folder here")
            return str(paths.share_dir("launch").parent)
        case "find-exec":
            [program] = exactly(1, "one program")
            found = shutil.which(program, path=context.environment.get("PATH"))
            if found is None:
                raise SubstitutionError(f"program {program!r} is not in PATH")
            return found
        case "anon":
            [stem] = exactly(1, "one name")
            return f"{stem}_{os.getpid()}_{next(_anonymous)}"
        case "equals" | "not-equals":
            left, right = exactly(2, "two values")
            return _word((left == right) == (name == "equals"))
        case "not":
            return _word(not truth(exactly(1, "one truth value")[0]))
        case "and" | "or":
            one, other = map(truth, exactly(2, "two truth values"))
            return _word(one and other if name == "and" else one or other)
        case "if":
            if len(words) not in (2, 3):
                raise SubstitutionError(f"$(if CONDITION THEN ELSE) takes two or three values, got {rest.strip()!r}")
            return words[1] if truth(words[0]) else "".join(words[2:])
    if name in _NOT_HERE:
        raise SubstitutionError(f"$({name} ...) is not supported here: {_NOT_HERE[name]}")
    raise SubstitutionError(f"unknown substitution $({name} ...); known: {_KNOWN}")


def _word(value: bool) -> str:
    return "true" if value else "false"


def _arguments(text: str, context: Context) -> list[str]:
    """Arguments of a substitution; quotes group words, and a nested substitution is never split."""
    words: list[str] = []
    current: str | None = None
    quote = ""
    position = 0
    while position < len(text):
        letter = text[position]
        if text.startswith("$(", position):
            end = _matching_parenthesis(text, position + 2)
            current = (current or "") + _evaluate(text[position + 2 : end], context)
            position = end
        elif quote:
            if letter == quote:
                quote = ""
            else:
                current = (current or "") + letter
        elif letter in "'\"" and current is None:
            quote, current = letter, ""
        elif letter.isspace():
            words += [current] if current is not None else []
            current = None
        else:
            current = (current or "") + letter
        position += 1
    if quote:
        raise SubstitutionError(f"unclosed {quote} in {text.strip()!r}")
    return words + ([current] if current is not None else [])


def _unwrapped(text: str) -> str:
    """The text without enclosing quotes: ROS 2 puts the whole expression of an ``eval`` into quotes."""
    for quote in "'\"":
        inside = text[1:-1]
        if len(text) > 1 and text[0] == text[-1] == quote and quote not in inside.replace(f"\\{quote}", ""):
            # A single quoted word is an operand without its quotes too, so removing them changes nothing.
            return inside.replace(f"\\{quote}", quote)
    return text


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
                # A quoted operand may contain substitutions; their value is text, never an operator.
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
        for symbol, holds in _ORDER.items():
            if self._take(symbol):
                return holds(self._number(left), self._number(self._operand()))
        return truth(left)

    def _number(self, text: str) -> float:
        try:
            return float(text)
        except ValueError:
            raise SubstitutionError(f"$(eval {self.text}): {text!r} is not a number") from None

    def _operand(self) -> str:
        if self.position < len(self.tokens) and self.tokens[self.position][0] == "operand":
            self.position += 1
            return self.tokens[self.position - 1][1]
        raise SubstitutionError(f"$(eval {self.text}): an operand is missing")
