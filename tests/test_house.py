"""Limits on names, sizes and docstrings of the code (CONTRIBUTING.md)."""

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("instant_ic", "nodes", "benchmarks", "scripts")
FUNCTION_LINES, CLASS_LINES, METHODS, PARAMETERS = 60, 400, 30, 10
OPENINGS = {"Of", "That", "As", "What", "Where", "Whether", "So"}
"""First words that a docstring must not have."""

Function = ast.FunctionDef | ast.AsyncFunctionDef
Definition = Function | ast.ClassDef


def definitions(tree: ast.AST, prefix: str = "") -> list[tuple[str, Definition]]:
    """Return all classes and functions of a module with their qualified names."""
    found: list[tuple[str, Definition]] = []
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, Definition):
            found.append((prefix + node.name, node))
            found += definitions(node, f"{prefix}{node.name}.")
        else:
            found += definitions(node, prefix)
    return found


def is_compiled(function: Function) -> bool:
    """Return whether numba or Triton compiles the function."""
    names = " ".join(ast.unparse(decorator) for decorator in function.decorator_list)
    return "jit" in names or "triton" in names


def parameters(function: Function) -> int:
    """Count the parameters without ``self`` and ``cls``."""
    names = [a.arg for a in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def docstrings(tree: ast.AST, name: str) -> list[tuple[str, str]]:
    """Return the docstrings of a module, its classes, functions and attributes with their names."""
    found = []
    for owner, node in [(name, tree), *definitions(tree)]:
        text = ast.get_docstring(node)
        found += [(owner, text)] if text else []
        for before, after in zip(node.body, node.body[1:], strict=False):
            assigned = isinstance(before, ast.Assign | ast.AnnAssign)
            if assigned and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                found.append((f"{owner}:{after.lineno}", str(after.value.value)))
    return found


def violations_of(tree: ast.Module, name: str) -> list[tuple[str, str]]:
    """Return (rule, name) of everything in one module that is too large or begins in the wrong way."""
    found = []
    for owner, node in definitions(tree):
        lines = node.end_lineno - node.lineno + 1
        if isinstance(node, ast.ClassDef):
            methods = sum(isinstance(child, Function) for child in node.body)
            found += [("class lines", owner)] if lines > CLASS_LINES else []
            found += [("methods", owner)] if methods > METHODS else []
        else:
            found += [("function lines", owner)] if lines > FUNCTION_LINES else []
            found += [("parameters", owner)] if parameters(node) > PARAMETERS and not is_compiled(node) else []
    for owner, text in docstrings(tree, name):
        words = text.split(maxsplit=1)
        found += [("docstring opening", owner)] if words and words[0].strip(".,:;") in OPENINGS else []
    return found


@pytest.fixture(scope="module")
def violations() -> dict[str, set[str]]:
    """Names that break a rule, by rule."""
    found: dict[str, set[str]] = {}
    classes: Counter[str] = Counter()
    for folder in FOLDERS:
        for file in sorted((ROOT / folder).rglob("*.py")):
            tree = ast.parse(file.read_text(encoding="utf-8"))
            classes.update(node.name for _, node in definitions(tree) if isinstance(node, ast.ClassDef))
            for rule, name in violations_of(tree, str(file.relative_to(ROOT))):
                found.setdefault(rule, set()).add(name)
    found["class name"] = {name for name, count in classes.items() if count > 1}
    return found


@pytest.mark.parametrize(
    ("rule", "advice"),
    [
        ("class name", "two classes have this name: give one of them a more specific name"),
        ("function lines", f"more than {FUNCTION_LINES} lines: split it along the steps of the algorithm"),
        ("class lines", f"more than {CLASS_LINES} lines: move a part into a class of its own"),
        ("methods", f"more than {METHODS} methods: move a part into a class of its own"),
        ("parameters", f"more than {PARAMETERS} parameters: group them in a dataclass"),
        (
            "docstring opening",
            "write an imperative sentence (functions) or a noun phrase (modules, classes, properties)",
        ),
    ],
)
def test_code_keeps_to_the_limits(rule, advice, violations):
    found = violations.get(rule, set())
    assert not found, f"{rule}: {advice}: {sorted(found)}"
