#!/usr/bin/env python3
"""Checks comments, docstrings, messages and docs against the glossary: prints FILE:LINE and the word to use instead.

    python scripts/check_words.py [FILE...]      # default: all tracked Python, JavaScript, YAML and Markdown files

Identifiers are not checked. Exit status 1 if anything was found.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NOT_YET = ("tests/", "CHANGELOG.md", "scripts/check_words.py")
"""Parts that are still to be rewritten; do not add to them."""
INSTEAD = {
    r"pictures?": "image, panorama, frame or view",
    r"told|tells?": "report, log, publish or warn",
    r"anew": "again, or restart",
    r"torn": "depth discontinuity",
    r"painted": "rendered",
    r"for so long": "for timeout_s",
    r"(?:let|lets|letting) (?:it )?out": "release",
    r"stands? in (?:for|the)": "replaces, or fallback",
    r"of its own word": "by itself",
    r"(?:come|comes|came) up": "start",
    r"whoever|whatever is": "name it",
}
WRONG = {re.compile(rf"(?<![\w`./-])(?:{words})(?![\w`/-])", re.IGNORECASE): use for words, use in INSTEAD.items()}


def prose(path: Path) -> list[tuple[int, str]]:
    """Lines of a file that are text for people, with their numbers.

    Raises:
        SyntaxError: Python that cannot be read.
    """
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return list(enumerate(re.sub(r"`[^`\n]*`", "", text).splitlines(), 1))
    if path.suffix in (".yaml", ".js"):
        mark = "#" if path.suffix == ".yaml" else "//"
        found = [(number, line.partition(mark)[2]) for number, line in enumerate(text.splitlines(), 1)]
        return [(number, comment) for number, comment in found if comment]
    lines = []
    argument = re.compile(r"^\s+(?:tell|pictures|picture|told)(?:, \w+)*:")  # a parameter's name in a docstring
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT or (token.type == tokenize.STRING and " " in token.string):
            text_only, code = token.string, 1
            while code:  # braces in braces
                text_only, code = re.subn(r"\{[^{}\n]*\}|``?[^`\n]*``?", "", text_only)
            lines += [
                (token.start[0] + i, line) for i, line in enumerate(text_only.split("\n")) if not argument.match(line)
            ]
    return lines


def main() -> int:
    """Checks the files of the command line."""
    names = sys.argv[1:]
    if not names:
        patterns = ["*.py", "*.js", "*.yaml", "*.md"]
        listed = subprocess.run(["git", "ls-files", *patterns], cwd=ROOT, capture_output=True, text=True, check=True)
        names = [name for name in listed.stdout.splitlines() if not name.startswith(NOT_YET)]
    found = 0
    for name in names:
        for number, line in prose(ROOT / name):
            for pattern, use in WRONG.items():
                for match in pattern.finditer(line):
                    print(f"{name}:{number}: {match.group(0)!r}: use {use}")
                    found += 1
    return found > 0


if __name__ == "__main__":
    sys.exit(main())
