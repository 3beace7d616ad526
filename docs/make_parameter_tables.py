"""Write the parameters' tables into ``docs/paper-to-code.md`` from the code.

python docs/make_parameter_tables.py
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

PAGE = Path(__file__).parent / "paper-to-code.md"
SOURCES = ("detector.py", "near.py", "estimators.py", "voting/params.py")
BEGIN, END = "<!-- parameters: begin -->", "<!-- parameters: end -->"
_METHOD = Path(__file__).parents[1] / "tooltip_cli" / "method"
_SECTION = re.compile(r"\((\d\.\d[^)]*)\)")
_NOT = re.compile(r";? ?not in the paper$")


def tables() -> str:
    """Return a table for every class of parameters."""
    parts = []
    for source in SOURCES:
        text = (_METHOD / source).read_text(encoding="utf-8")
        for node in ast.parse(text).body:
            if isinstance(node, ast.ClassDef) and node.name.endswith("Params"):
                rows = "\n".join(_rows(node, text.splitlines()))
                place = f"../tooltip_cli/method/{source}"
                parts.append(
                    f"### [`{node.name}`]({place})\n\n{ast.get_docstring(node)}\n\n"
                    f"| parameter | value | in the paper | what |\n|---|---|---|---|\n{rows}\n"
                )
    return "\n".join(parts)


def _rows(node: ast.ClassDef, lines: list[str]) -> Iterator[str]:
    for item in node.body:
        if isinstance(item, ast.AnnAssign) and isinstance(item.value, (ast.Constant, ast.UnaryOp)):
            name = ast.unparse(item.target)
            comment = lines[item.lineno - 1].partition("  # ")[2]
            section = _SECTION.search(comment)
            where = section[1] if section else "no"
            what = _SECTION.sub("", _NOT.sub("", comment)).strip()
            yield f"| `{name}` | {ast.unparse(item.value)} | {where} | {what} |"


def page(text: str) -> str:
    """Return the page with the tables of today between its marks."""
    head, _, rest = text.partition(BEGIN)
    _, _, tail = rest.partition(END)
    return f"{head}{BEGIN}\n\n{tables()}\n{END}{tail}"


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
