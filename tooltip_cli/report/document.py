"""What every page of ours begins and ends with: self-contained, and asking no host for anything."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import resources

from tooltip_cli.report.charts import escape

_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "base-uri 'none'; form-action 'none'"
)


def head(title: str, lead: str) -> str:
    """Return a page up to and with the start of its main part."""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<meta name="color-scheme" content="light dark">
<title>{escape(title)}</title>
<style>
{packaged("page.css")}</style>
</head>
<body>
<header>
<h1>{escape(title)}</h1>
<p class="lead">{escape(lead)}</p>
</header>
<main>
"""


def packaged(name: str) -> str:
    """Return a text file that lies beside this module."""
    return resources.files("tooltip_cli.report").joinpath(name).read_text(encoding="utf-8")


def table_rows(body: Iterable[Sequence[str]]) -> Iterable[str]:
    """Yield table rows; cells are HTML, the first names the row."""
    for first, *rest in body:
        cells = "".join(f"<td>{cell}</td>" for cell in rest)
        yield f'<tr><th scope="row">{first}</th>{cells}</tr>\n'
