"""YAML text from outside, read without surprises."""

from __future__ import annotations

import reprlib
from typing import Any

import yaml

from tooltip_cli.errors import TooltipError

_SHORT = reprlib.Repr()
_SHORT.maxlevel = 1


def parse_yaml(text: str, source: str) -> Any:
    """Return the value of a YAML document (safe types only).

    Args:
        source: the document's name, for messages.

    Raises:
        TooltipError: not YAML, or a value that its own type cannot hold.
    """
    try:
        return yaml.safe_load(text)
    except RecursionError as error:
        raise TooltipError(f"{source}: not YAML that can be read (nested too deeply)") from error
    # scalars such as 2020-99-99 reach constructors that raise ValueError, KeyError and others
    except Exception as error:
        raise TooltipError(f"{source}: not YAML ({' '.join(str(error).split())})") from error


def shown(value: Any) -> str:
    """Return a short spelling of a value; aliases can make a whole one endless."""
    return " ".join(_SHORT.repr(value).split())
