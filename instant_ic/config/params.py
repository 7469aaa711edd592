"""Turn ROS 2 YAML files and ``key:=value`` overrides into a node's typed, checked configuration.

File form::

    /**:
      ros__parameters: {use_sim_time: false}     # every node
    grid_slam:
      ros__parameters:
        resolution: 0.05                         # metres
"""

from __future__ import annotations

import dataclasses
import difflib
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import yaml

from instant_ic.config.ranges import Range, check_ranges, range_of

ConfigT = TypeVar("ConfigT")


class ParameterError(ValueError):
    """A parameter is unknown, of the wrong type or out of range; the message says where."""


@dataclass(frozen=True)
class Value:
    """A value with its origin (``config/slam.yaml:12`` or ``-p key:=value``)."""

    value: Any
    where: str


Values = dict[str, Value]
"""Dotted key → value."""


@dataclass(frozen=True)
class ProcessParameters:
    """Parameters that every node has in addition to its own.

    Attributes:
        use_sim_time: the clock follows ``/clock``; callbacks wait for its first value.
        nice: a node with a higher value yields the CPU to the others when there is not enough for all.
    """

    use_sim_time: bool = False
    nice: Annotated[int, Range(0, 19)] = 0

    def __post_init__(self) -> None:
        """Checks the values."""
        check_ranges(self)


def load_file(path: Path, node: str) -> Values:
    """Read the parameters of one node from a ROS 2 parameter file; ``/**`` sections apply first.

    Raises:
        ParameterError: the file cannot be read, is not YAML, or has the wrong structure.
    """
    try:
        text = path.read_text()
    except OSError as error:
        raise ParameterError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ParameterError(f"{path}: cannot be read as UTF-8: {error}") from error
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        return {} if root is None else _sections(root, path, node)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{path}:{mark.line + 1}" if mark else str(path)
        raise ParameterError(f"{where}: not YAML: {getattr(error, 'problem', error)}") from error
    except RecursionError:
        raise ParameterError(f"{path}: nested endlessly: does an anchor contain itself?") from None


def _sections(root: yaml.Node, path: Path, node: str) -> Values:
    sections: dict[str, Values] = {}
    for name, section in _items(root, path):
        values: Values = {}
        for key, body in _items(section, path):
            if key != "ros__parameters":
                raise ParameterError(f"{_where(path, body)}: expected ros__parameters under {name!r}, found {key!r}")
            _flatten(body, "", path, values)
        sections[name.strip("/") if name != "/**" else name] = values
    return {**sections.get("/**", {}), **sections.get(node, {})}


def _where(path: Path, node: yaml.Node) -> str:
    return f"{path}:{node.start_mark.line + 1}"


def _items(node: yaml.Node, path: Path) -> list[tuple[str, yaml.Node]]:
    if isinstance(node, yaml.ScalarNode) and node.value == "":
        return []
    if not isinstance(node, yaml.MappingNode):
        raise ParameterError(f"{_where(path, node)}: expected a mapping (node name: ros__parameters: key: value)")
    items = [(str(key.value), value) for key, value in node.value]
    keys = [key for key, _ in items]
    for (key, value), at in zip(items, range(len(keys)), strict=True):
        if key in keys[:at]:
            raise ParameterError(f"{_where(path, value)}: {key!r} is given twice")
    return items


def _flatten(node: yaml.Node, prefix: str, path: Path, out: Values) -> None:
    for key, value in _items(node, path):
        if isinstance(value, yaml.MappingNode) and value.value:
            _flatten(value, f"{prefix}{key}.", path, out)
        else:
            out[prefix + key] = Value(_construct(value, f"{_where(path, value)}: {prefix}{key}"), _where(path, value))


_YAML_FAULTS = (yaml.YAMLError, ValueError, AttributeError)
"""What PyYAML raises for an invalid value: 2001-13-45 is a ValueError, ``!!timestamp x`` an AttributeError."""


def _construct(node: yaml.Node, what: str) -> Any:
    loader = yaml.SafeLoader("")
    try:
        return loader.construct_object(node, deep=True)
    except _YAML_FAULTS as error:
        raise ParameterError(f"{what}: the value is not YAML: {_one_line(error)}") from error
    finally:
        loader.dispose()


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


def yaml_value(text: str, what: str) -> Any:
    """Parse a value typed by the user.

    Args:
        text: YAML.
        what: prefix of the error message.

    Raises:
        ParameterError: the text is not YAML.
    """
    try:
        return yaml.safe_load(text)
    except _YAML_FAULTS as error:
        raise ParameterError(f"{what}: the value is not YAML: {_one_line(error)}") from error
    except RecursionError:
        raise ParameterError(f"{what}: the value is nested too deeply") from None


def parse_override(word: str) -> tuple[str, Value]:
    """Parse ``key:=value`` with a YAML value.

    Raises:
        ParameterError: there is no ``:=``, or the value is not YAML.
    """
    key, separator, text = word.partition(":=")
    if not separator or not key:
        raise ParameterError(f"-p {word}: expected key:=value")
    return key, Value(yaml_value(text, f"-p {word}"), f"-p {word}")


def build(config_class: type[ConfigT], values: Mapping[str, Value], base: ConfigT | None = None) -> ConfigT:
    """Typed configuration from flat values; errors name the place of an unknown key or a wrong type.

    Args:
        config_class: dataclass of the configuration.
        values: the given values.
        base: source of all other values; None uses the defaults.

    Raises:
        ParameterError: see above, or ``__post_init__`` refused the values.
    """
    return _build(config_class, dict(values), "", base)


def _build(config_class: type[ConfigT], values: Values, prefix: str, base: ConfigT | None) -> ConfigT:
    hints = get_type_hints(config_class, include_extras=True)
    fields = {f.name: f for f in dataclasses.fields(config_class)}  # type: ignore[arg-type]
    arguments: dict[str, Any] = {}
    nested: dict[str, Values] = {}
    for key, value in values.items():
        head, _, rest = key.partition(".")
        full = prefix + key
        if head not in fields:
            close = difflib.get_close_matches(head, fields, n=1)
            hint = f"; did you mean {prefix + close[0]!r}?" if close else f"; known: {', '.join(sorted(fields))}"
            raise ParameterError(f"{value.where}: unknown parameter {full!r}{hint}")
        if dataclasses.is_dataclass(hints[head]):
            if not rest:
                raise ParameterError(f"{value.where}: parameter {full!r} is a group: give {full}.<name>")
            nested.setdefault(head, {})[rest] = value
        elif rest:
            raise ParameterError(f"{value.where}: parameter {prefix + head!r} has no part {rest!r}")
        else:
            arguments[head] = _coerce(value.value, hints[head], full, value.where)
    for head, inner in nested.items():
        # A group's defaults come from its parent: another group of the same class may have different ones.
        group = field_default(fields[head]) if base is None else getattr(base, head)
        arguments[head] = _build(hints[head], inner, f"{prefix}{head}.", group)
    try:
        return config_class(**arguments) if base is None else dataclasses.replace(base, **arguments)  # type: ignore[type-var]
    except ValueError as error:
        if isinstance(error, ParameterError):
            raise
        where = next((v.where for k, v in values.items() if k.split(".")[0] in str(error)), "parameters")
        raise ParameterError(f"{where}: {error}") from error


def field_default(field: dataclasses.Field[Any]) -> Any:
    """Default of a configuration's field; None if it has none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def _coerce(value: Any, hint: Any, key: str, where: str) -> Any:
    """Convert a value to the declared type of its field."""
    origin = get_origin(hint)
    if origin is Annotated:
        plain = _coerce(value, get_args(hint)[0], key, where)
        bounds = range_of(hint)
        if bounds is not None and plain is not None and plain not in bounds:
            raise ParameterError(f"{where}: {key} {bounds.words} (got {value})")
        return plain
    if origin in (typing.Union, UnionType):
        options = get_args(hint)
        if value is None and NoneType in options:
            return None
        return _coerce(value, next(o for o in options if o is not NoneType), key, where)
    if origin is typing.Literal:
        if value in get_args(hint):
            return value
        raise ParameterError(f"{where}: {key} must be one of {', '.join(map(str, get_args(hint)))} (got {value!r})")
    if hint is bool and isinstance(value, bool):
        return value
    if hint is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if hint is str and isinstance(value, (str, int, float)) and not isinstance(value, bool):
        return str(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    if origin in (tuple, list) and isinstance(value, list):
        return _coerce_sequence(value, origin, get_args(hint), key, where)
    if hint is Any:
        return value
    wanted = getattr(hint, "__name__", str(hint)) if origin is None else str(hint)
    raise ParameterError(f"{where}: {key} must be {wanted} (got {value!r})")


def _coerce_sequence(value: list[Any], origin: Any, arguments: tuple[Any, ...], key: str, where: str) -> Any:
    if origin is tuple and arguments and arguments[-1] is not Ellipsis:
        if len(value) != len(arguments):
            raise ParameterError(f"{where}: {key} must have {len(arguments)} values (got {len(value)})")
        hints = list(arguments)
    else:
        hints = [arguments[0] if arguments else Any] * len(value)
    return origin(_coerce(v, h, f"{key}[{i}]", where) for i, (v, h) in enumerate(zip(value, hints, strict=True)))


def to_dict(config: Any) -> dict[str, Any]:
    """Configuration as nested plain values, for ``ic param`` and the registry."""
    return {key: str(value) if isinstance(value, Path) else value for key, value in dataclasses.asdict(config).items()}


def change(
    config: ConfigT, values: Mapping[str, Any], is_live: Callable[[str], bool], where: str
) -> tuple[ConfigT, dict[str, Any]]:
    """Apply new values to a configuration and check it as a whole; returns it with what differs (flat).

    Args:
        config: the present configuration.
        values: flat or nested keys; unchanged values are allowed.
        is_live: whether a key may be changed while the node runs.
        where: prefix of the error messages.

    Raises:
        ParameterError: a value is wrong, or its parameter takes effect only at the start.
    """
    flat = {key: Value(value, where) for key, value in flatten(values).items()}
    changed = build(type(config), flat, config)
    before, after = flatten(to_dict(config)), flatten(to_dict(changed))
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
