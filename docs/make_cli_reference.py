"""Write ``docs/cli.md`` from the commands' own ``--help``.

python docs/make_cli_reference.py
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click

from tooltip_cli.cli.main import main as tooltip

PAGE = Path(__file__).parent / "cli.md"
_WIDTH = 88
_HEAD = """\
# Commands

Made from `--help` by `docs/make_cli_reference.py`; `make docs` writes it anew.

Results go to stdout, everything else to stderr. Exit codes: 0 done, 1 expected error (one line that
says what to do), 2 wrong usage, 3 refused: no trustworthy answer exists in this data.
"""


def commands(
    command: click.Command, name: str, parent: click.Context | None = None
) -> Iterator[tuple[str, click.Command, click.Context]]:
    """Yield every command with its full name and context, in the order of ``--help``."""
    context = click.Context(
        command,
        parent=parent,
        info_name=name,
        terminal_width=_WIDTH,
        max_content_width=_WIDTH,
        help_option_names=["-h", "--help"],
    )
    yield context.command_path, command, context
    if isinstance(command, click.Group):
        for child in command.list_commands(context):
            found = command.get_command(context, child)
            if found is not None:
                yield from commands(found, child, context)


def page() -> str:
    """Return the whole page."""
    parts = [_HEAD]
    for path, command, context in commands(tooltip, "tooltip"):
        level = "#" * (1 + len(path.split()))
        parts.append(f"{level} {path}\n\n```text\n{command.get_help(context)}\n```\n")
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
