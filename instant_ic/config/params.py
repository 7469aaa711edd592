"""A node's typed, checked configuration from ROS 2 YAML files and ``key:=value`` overrides.

File form::

    /**:
      ros__parameters: {rate_hz: 20.0}           # for every node that has this parameter
    grid_slam:
      ros__parameters:
        resolution: 0.05                         # metres
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import typing
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import yaml

from instant_ic.config.ranges import Checked, Range, range_of
from instant_ic.config.scalars import READERS, is_null
from instant_ic.config.yaml_place import YamlPlace, YamlProblem, load
from instant_ic.config.yaml_text import read_spelled, resolved
from instant_ic.util.safe_text import masked, masked_values

ConfigT = TypeVar("ConfigT")

_MOST_SHOWN = 80
"""Number of characters of a refused value that the error shows."""

SHARED = "/**"
"""Section of a parameter file for all nodes. A node ignores values for which it has no parameter."""


@dataclass(frozen=True)
class Problem:
    """One mistake in parameters.

    Attributes:
        where: place of the mistake (``config/slam.yaml:12`` or ``-p key:=value``); empty if no given value is at fault.
        key: parameter at fault; empty if no single one is.
    """

    text: str
    where: str = ""
    key: str = ""

    def __str__(self) -> str:
        """Return ``where: text``."""
        return f"{self.where}: {self.text}" if self.where else self.text


class ParameterError(ValueError):
    """Parameters are unknown, of the wrong type or out of range; ``problems`` lists each mistake with its place."""

    def __init__(self, *problems: Problem | str) -> None:
        self.problems = tuple(Problem(p) if isinstance(p, str) else p for p in problems)
        super().__init__("\n".join(map(str, self.problems)))


@dataclass(frozen=True)
class Value:
    """A value with its origin.

    Attributes:
        given: value with the spelling of its scalars (``yaml_text.spelled``), or a plain value.
        where: place of the value, ``config/slam.yaml:12`` or ``-p key:=value``.
        file: the parameter file; None for the command line.
        shared: true if the value comes from a ``/**`` section, which nodes without this parameter ignore.
    """

    given: Any
    where: str
    file: Path | None = None
    shared: bool = False

    @property
    def value(self) -> Any:
        """Plain value, with the type that YAML 1.1 gives it."""
        return resolved(self.given)


Values = dict[str, Value]
"""Dotted key → value."""


@dataclass(frozen=True)
class ProcessParameters(Checked):
    """Parameters that every node has in addition to its own.

    Attributes:
        use_sim_time: follow ``/clock``; callbacks wait for its first value.
        nice: priority as of Unix ``nice``; a node with a higher value yields the CPU to others when it is short.
    """

    use_sim_time: bool = False
    nice: Annotated[int, Range(0, 19)] = 0


PROCESS_KEYS = ("use_sim_time", "nice")
"""Names of :class:`ProcessParameters`."""


def gather(
    node: str, files: Sequence[Path], overrides: Sequence[str], places: Mapping[str, str] | None = None
) -> Values:
    """Return all values given to a node: the files in their order, then the ``key:=value`` overrides.

    Args:
        node: name of the node.
        files: parameter files.
        overrides: ``key:=value`` texts.
        places: override to its place in a launch file; others are attributed to the command line.

    Raises:
        ParameterError: files or overrides cannot be read; the error lists all of them.
    """
    values: Values = {}
    problems: list[Problem] = []
    for file in files:
        try:
            values.update(load_file(file, node))
        except ParameterError as error:
            problems += error.problems
    for text in overrides:
        where = (places or {}).get(text, f"-p {masked(text)}")
        try:
            key, value = parse_override(text)
            values[key] = dataclasses.replace(value, where=where)
        except ParameterError as error:
            problems += [dataclasses.replace(problem, where=problem.where and where) for problem in error.problems]
    if problems:
        raise ParameterError(*problems)
    return values


def configure(config_class: type[ConfigT], values: Mapping[str, Value]) -> tuple[ConfigT, ProcessParameters]:
    """Return the typed configuration of a node, and the parameters of its process.

    Raises:
        ParameterError: values are refused; the error lists all of them.
    """
    own = {key: value for key, value in values.items() if key not in PROCESS_KEYS}
    common = {key: value for key, value in values.items() if key in PROCESS_KEYS}
    problems: list[Problem] = []
    made: list[Any] = []
    for kind, part in ((config_class, own), (ProcessParameters, common)):
        try:
            made.append(build(kind, part))
        except ParameterError as error:
            problems += error.problems
    if problems:
        raise ParameterError(*problems)
    return made[0], made[1]


def load_file(path: Path, node: str) -> Values:
    """Read the parameters of one node from a ROS 2 parameter file. Its own section overrides ``/**``.

    Raises:
        ParameterError: the file cannot be read, is not YAML, or has the wrong structure.
    """
    sections = load_sections(path)
    return {**sections.get(SHARED, {}), **sections.get(node, {})}


def load_sections(path: Path) -> dict[str, Values]:
    """Read all sections of a ROS 2 parameter file, by node name or ``/**``.

    Raises:
        ParameterError: see :func:`load_file`.
    """
    sections: dict[str, Values] = {}
    try:
        for title, section in load(path).fields().items():
            name = title if title == SHARED else title.strip("/")
            values = sections.setdefault(name, {})
            for key, body in section.fields().items():
                if key != "ros__parameters":
                    raise body.problem(f"expected ros__parameters under {title!r}, found {key!r}")
                _flatten(body, "", values, name == SHARED)
    except YamlProblem as error:
        raise ParameterError(Problem(error.text, f"{path}:{error.line}")) from error
    return sections


def _flatten(group: YamlPlace, prefix: str, out: Values, shared: bool) -> None:
    for key, value in group.fields().items():
        if value.is_mapping and value.fields():
            _flatten(value, f"{prefix}{key}.", out, shared)
        else:
            out[prefix + key] = Value(value.spelled(), f"{value.file}:{value.line}", value.file, shared)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


def yaml_value(text: str, what: str) -> Any:
    """Parse a value typed by the user. Unquoted scalars keep their spelling.

    Args:
        text: YAML.
        what: place named in the error.

    Raises:
        ParameterError: the text is not YAML.
    """
    try:
        return read_spelled(text)
    except yaml.YAMLError as error:
        raise ParameterError(Problem(f"the value is not YAML: {_one_line(error)}", what)) from error


def parse_override(word: str) -> tuple[str, Value]:
    """Parse ``key:=value`` with a YAML value.

    Raises:
        ParameterError: there is no ``:=``, or the value is not YAML.
    """
    key, separator, text = word.partition(":=")
    if not separator or not key:
        raise ParameterError(Problem("expected key:=value", f"-p {word}"))
    return key, Value(yaml_value(text, f"-p {word}"), f"-p {word}")


def build(config_class: type[ConfigT], values: Mapping[str, Value], base: ConfigT | None = None) -> ConfigT:
    """Return a typed configuration from flat values.

    A shared value without a parameter in this configuration is meant for other nodes and is skipped.

    Args:
        config_class: the configuration's class.
        values: values by dotted key.
        base: source of all other values; None uses the defaults.

    Raises:
        ParameterError: keys are unknown, or values have the wrong type, are out of range or are refused by
            ``__post_init__``; the error lists all of them.
    """
    problems: list[Problem] = []
    typed: dict[str, Any] = {}
    for key, value in values.items():
        try:
            typed[key] = typed_value(config_class, key, value.given)
        except _UnknownError as error:
            if not value.shared:
                problems.append(Problem(str(error), value.where, key))
        except _RefusedError as error:
            problems.append(Problem(str(error), value.where, key))
    if problems and base is None and _required(config_class) - typed.keys():
        raise ParameterError(*problems)  # the configuration cannot be built without the refused values
    while True:
        try:
            config = _assemble(config_class, typed, base)
            break
        except ValueError as error:
            key = _culprit(config_class, typed, base, error)
            problems.append(Problem(str(error), values[key].where if key else "", key))
            if not key:
                break
            del typed[key]
    if problems:
        raise ParameterError(*problems)
    return config


def typed_value(config_class: type[Any], key: str, given: Any) -> Any:
    """Return a given value as the declared type of its parameter, checked against the range.

    Raises:
        ValueError: there is no such parameter, or the value does not fit.
    """
    try:
        return _coerce(given, _type_of(config_class, key), key)
    except yaml.YAMLError as error:
        raise _RefusedError(f"{key}: the value is not YAML: {_one_line(error)}") from None


def _required(config_class: type[Any]) -> set[str]:
    missing = dataclasses.MISSING
    return {f.name for f in dataclasses.fields(config_class) if f.default is missing and f.default_factory is missing}


class _RefusedError(ValueError):
    """A value is refused."""


class _UnknownError(_RefusedError):
    """There is no such parameter."""


@functools.cache
def _hints(config_class: type[Any]) -> dict[str, Any]:
    hints = get_type_hints(config_class, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(config_class)}


def _type_of(config_class: type[Any], key: str) -> Any:
    group, names = config_class, key.split(".")
    for index, name in enumerate(names):
        hints, prefix = _hints(group), "".join(f"{part}." for part in names[:index])  # type: ignore[arg-type]
        if name not in hints:
            close = difflib.get_close_matches(name, hints, n=1)
            hint = f"; did you mean {prefix + close[0]!r}?" if close else f"; known: {', '.join(sorted(hints))}"
            raise _UnknownError(f"unknown parameter {key!r}{hint}")
        if not dataclasses.is_dataclass(hints[name]):
            if rest := ".".join(names[index + 1 :]):
                raise _RefusedError(f"parameter {prefix + name!r} has no part {rest!r}")
            return hints[name]
        group = hints[name]
    raise _RefusedError(f"parameter {key!r} is a group: give {key}.<name>")


def _assemble(config_class: type[ConfigT], typed: Mapping[str, Any], base: ConfigT | None) -> ConfigT:
    """Build a configuration from flat typed values. A dataclass's own check may raise ValueError."""
    arguments: dict[str, Any] = {}
    groups: dict[str, dict[str, Any]] = {}
    for key, value in typed.items():
        head, _, rest = key.partition(".")
        if rest:
            groups.setdefault(head, {})[rest] = value
        else:
            arguments[head] = value
    fields = {field.name: field for field in dataclasses.fields(config_class)}  # type: ignore[arg-type]
    for head, inner in groups.items():
        # A group's defaults come from its parent, as two groups of one class may have different defaults.
        group = field_default(fields[head]) if base is None else getattr(base, head)
        arguments[head] = _assemble(_hints(config_class)[head], inner, group)  # type: ignore[arg-type]
    return config_class(**arguments) if base is None else dataclasses.replace(base, **arguments)  # type: ignore[type-var]


def _culprit(config_class: type[Any], typed: Mapping[str, Any], base: Any, error: ValueError) -> str:
    """Return the key of the first value without which the error disappears or changes; empty if none is found."""
    for key in typed:
        try:
            _assemble(config_class, {other: value for other, value in typed.items() if other != key}, base)
        except ValueError as remaining:
            if str(remaining) == str(error):
                continue
        return key
    return ""


def field_default(field: dataclasses.Field[Any]) -> Any:
    """Return the default of a configuration's field; None if it has none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."


def _coerce(value: Any, hint: Any, key: str) -> Any:
    origin = get_origin(hint)
    if origin is Annotated:
        plain = _coerce(value, get_args(hint)[0], key)
        bounds = range_of(hint)
        if bounds is not None and plain is not None and plain not in bounds:
            raise _RefusedError(f"{key} {bounds.refusal(plain, value)}")
        return plain
    if origin in (typing.Union, UnionType):
        options = get_args(hint)
        if is_null(value) and NoneType in options:
            return None
        return _coerce(value, next(o for o in options if o is not NoneType), key)
    if origin is typing.Literal:
        for option in get_args(hint):
            with suppress(ValueError):
                if READERS[type(option)](value) == option:
                    return option
        raise _RefusedError(f"{key} must be one of {', '.join(map(str, get_args(hint)))} (got {_shown(value)})")
    if hint in READERS:
        try:
            return READERS[hint](value)
        except ValueError as error:
            raise _RefusedError(f"{key} {error} (got {_shown(value)})") from None
    if origin in (tuple, list) and isinstance(value, list):
        return _coerce_sequence(value, origin, get_args(hint), key)
    if hint is Any:
        return resolved(value)
    wanted = "a list" if origin in (tuple, list) else getattr(hint, "__name__", str(hint))
    raise _RefusedError(f"{key} must be {wanted} (got {_shown(value)})")


def _coerce_sequence(value: list[Any], origin: Any, arguments: tuple[Any, ...], key: str) -> Any:
    if origin is tuple and arguments and arguments[-1] is not Ellipsis:
        if len(value) != len(arguments):
            raise _RefusedError(f"{key} must have {len(arguments)} values (got {len(value)})")
        hints = list(arguments)
    else:
        hints = [arguments[0] if arguments else Any] * len(value)
    return origin(_coerce(v, h, f"{key}[{i}]") for i, (v, h) in enumerate(zip(value, hints, strict=True)))


def to_dict(config: Any) -> dict[str, Any]:
    """Return a configuration as nested plain values, with passwords in addresses masked."""
    masked_config: dict[str, Any] = masked_values(_plain_dict(config))
    return masked_config


def _plain_dict(config: Any) -> dict[str, Any]:
    return {key: str(value) if isinstance(value, Path) else value for key, value in dataclasses.asdict(config).items()}


def change(
    config: ConfigT, values: Mapping[str, Any], is_live: Callable[[str], bool], where: str
) -> tuple[ConfigT, dict[str, Any]]:
    """Apply new values to a configuration and check it as a whole. Return it and the changed values (flat).

    Args:
        config: the present configuration.
        values: flat or nested keys; unchanged values are allowed.
        is_live: function that returns whether a key may be changed while the node runs.
        where: prefix of the error messages.

    Raises:
        ParameterError: a value is wrong, or its parameter cannot be changed while the node runs.
    """
    flat = {key: Value(value, where) for key, value in flatten(values).items()}
    changed = build(type(config), flat, config)
    before, after = flatten(_plain_dict(config)), flatten(_plain_dict(changed))
    different = {key: value for key, value in after.items() if value != before[key]}
    if fixed := sorted(key for key in different if not is_live(key)):
        raise ParameterError(f"{where}: {', '.join(fixed)} takes effect at start: restart the node with the new value")
    return changed, different


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested values to dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            flat.update(flatten(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = value
    return flat
