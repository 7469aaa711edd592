"""YAML reader with a single type of error and a limit on expanded aliases."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import yaml

from instant_ic.config.scalars import Scalar

T = TypeVar("T")
# Exceptions that PyYAML raises for a value that does not fit its tag, such as `!!int "_"`.
_STRAY = (ValueError, TypeError, AttributeError, IndexError, KeyError, OverflowError)
_MOST_LEVELS = 100
_MOST_VALUES = 100_000
"""Largest number of values in a document, counting each use of an alias: 300 bytes of aliases can mean billions."""
_MOST_BITS = 10_000
"""Largest size of an integer in bits. Python cannot print a number of 4300 digits, not even in an error."""
_TEXT = yaml.resolver.BaseResolver.DEFAULT_SCALAR_TAG
_TOO_DEEP = "lists or mappings are nested too deeply, or an anchor contains itself"


class _Loader(yaml.SafeLoader):
    """Loader that refuses integers too long to be printed."""

    def construct_yaml_int(self, node: Any) -> int:
        value = int(super().construct_yaml_int(node))
        if value.bit_length() > _MOST_BITS:
            raise yaml.constructor.ConstructorError(None, None, "the number is too long", node.start_mark)
        return value


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


class _SpelledLoader(_Loader):
    """Loader that keeps the spelling of unquoted scalars and reads keys of mappings as text."""

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        # A quoted scalar is text, except in the form `! '1:30'`, which PyYAML writes for a number with a colon.
        plain = isinstance(node, yaml.ScalarNode) and (not node.style or node.tag != _TEXT)
        if plain and node.tag == _implicit_tag(node.value):
            return Scalar(node.value)
        return super().construct_object(node, deep)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        found = super().construct_mapping(node, deep)
        return {key.text if isinstance(key, Scalar) else key: value for key, value in found.items()}


def _implicit_tag(text: str) -> str:
    return str(_RESOLVER.resolve(yaml.ScalarNode, text, (True, False)))


_RESOLVER = yaml.SafeLoader("")


def read_yaml(text: str) -> Any:
    """Return the plain value of a YAML document.

    Raises:
        yaml.YAMLError: see :func:`compose_yaml`; or a value does not fit its type.
    """
    root = compose_yaml(text)
    return None if root is None else construct(root)


def read_spelled(text: str) -> Any:
    """Return the value of a YAML document whose unquoted scalars keep their spelling; see :func:`spelled`.

    Raises:
        yaml.YAMLError: see :func:`read_yaml`.
    """
    root = compose_yaml(text)
    return Scalar("") if root is None else spelled(root)


def compose_yaml(text: str) -> yaml.Node | None:
    """Return the root node of a YAML text, with line numbers; None for an empty text.

    The C parser is used if it is available, because it takes a tenth of the time.

    Raises:
        yaml.YAMLError: the text is not YAML, is nested too deeply, or its aliases expand to too many values.
    """
    root = _checked(lambda: _composed(text))
    if root is not None:
        _measure(root, 0, {})
    return root


def _composed(text: str) -> yaml.Node | None:
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    level = 0
    for event in yaml.parse(text, Loader=loader):  # compose() is recursive and could overflow the C stack
        level += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if level > _MOST_LEVELS:
            raise _refused(_TOO_DEEP, event)
    return yaml.compose(text, Loader=loader)


def construct(node: yaml.Node) -> Any:
    """Return the plain value of a node.

    Raises:
        yaml.YAMLError: a value does not fit its type.
    """
    return _constructed(node, _Loader(""))


def spelled(node: yaml.Node) -> Any:
    """Return a node's value as lists, mappings with text keys, :class:`Scalar`, and plain values of quoted scalars.

    Raises:
        yaml.YAMLError: a value does not fit its tag.
    """
    return _constructed(node, _SpelledLoader(""))


def _constructed(node: yaml.Node, loader: _Loader) -> Any:
    try:
        return _checked(lambda: loader.construct_object(node, deep=True))
    finally:
        loader.dispose()


def resolved(value: Any) -> Any:
    """Return a spelled value with its scalars converted to the types of YAML 1.1.

    Raises:
        yaml.YAMLError: a scalar does not fit its type, for example a date in month 13.
    """
    if isinstance(value, Scalar):
        return construct(yaml.ScalarNode(_implicit_tag(value.text), value.text))
    if isinstance(value, list):
        return [resolved(part) for part in value]
    return {key: resolved(part) for key, part in value.items()} if isinstance(value, dict) else value


class _Dumper(yaml.SafeDumper):
    """Dumper that keeps the spelling of :class:`Scalar`."""


_Dumper.add_representer(Scalar, lambda dumper, scalar: dumper.represent_scalar(_implicit_tag(scalar.text), scalar.text))


def dump_yaml(value: object, **style: Any) -> str:
    """Return YAML text. Keys keep their order and scalars their spelling."""
    return str(yaml.dump(value, Dumper=_Dumper, sort_keys=False, **style))


def one_line(value: object) -> str:
    """Return a value as one line of YAML."""
    text = dump_yaml(value, default_flow_style=True, allow_unicode=True, width=1 << 20)
    return text.rstrip("\n").removesuffix("\n...").rstrip("\n")


def _measure(node: yaml.Node, depth: int, known: dict[int, tuple[int, int]]) -> tuple[int, int]:
    """Return the number of values and levels of a node, counting each use of an alias.

    Args:
        node: the node.
        depth: level of the node in the document.
        known: results so far, by ``id`` of the node.

    Raises:
        yaml.YAMLError: there are too many values or levels.
    """
    if isinstance(node, yaml.ScalarNode):
        return 1, 0
    if depth > _MOST_LEVELS:
        raise _refused(_TOO_DEEP, node)
    if id(node) not in known:
        parts = node.value if isinstance(node, yaml.SequenceNode) else [part for pair in node.value for part in pair]
        sizes = [_measure(part, depth + 1, known) for part in parts]
        known[id(node)] = 1 + sum(size for size, _ in sizes), 1 + max((levels for _, levels in sizes), default=0)
    size, levels = known[id(node)]
    if depth + levels > _MOST_LEVELS + 1:
        raise _refused(_TOO_DEEP, node)
    if size > _MOST_VALUES:
        raise _refused(f"its aliases stand for more than {_MOST_VALUES} values", node)
    return size, levels


def _refused(problem: str, node: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


def _checked(read: Callable[[], T]) -> T:
    """Call a function of PyYAML and turn its stray exceptions into ``yaml.YAMLError``."""
    try:
        return read()
    except _STRAY as error:
        raise yaml.YAMLError(str(error)) from error
    except RecursionError:
        raise yaml.YAMLError(_TOO_DEEP) from None
