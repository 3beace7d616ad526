"""What the tests share: a small robot, recordings of it, and the command line."""

from __future__ import annotations

from collections.abc import Callable

from tooltip_cli.errors import TooltipError


def refusal(function: Callable[[], object]) -> str | None:
    """Return the message of the expected failure, None where there is none; others are raised."""
    try:
        function()
    except TooltipError as error:
        return str(error)
    return None
