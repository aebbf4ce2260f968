"""The page of promises names tests that exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
PAGE = (TESTS.parent / "docs" / "promises.md").read_text()
NAMED = re.findall(r"`(test_\w+\.py)((?:::\w+)*)`", PAGE)


def test_the_page_names_a_test_for_every_promise():
    rows = [
        line for line in PAGE.splitlines() if re.match(r"\| (?!-|under|input|event|asked)", line)
    ]
    rows = [row for row in rows if not row.startswith("|---")]
    assert len(rows) > 20
    for row in rows:
        assert re.search(r"`test_\w+\.py|`make soak", row), row


@pytest.mark.parametrize(("file", "path"), NAMED, ids="".join)
def test_every_test_named_exists(file, path):
    body = ast.parse((TESTS / file).read_text()).body
    for name in path.split("::")[1:]:
        found = [
            node
            for node in body
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.name == name
        ]
        assert found, f"{file}{path}"
        body = found[0].body
