"""YAML text from outside, read without surprises."""

from __future__ import annotations

import reprlib
from typing import Any

import yaml

from tooltip_cli.errors import TooltipError

_MAX_VALUES = 1_000_000
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
        value = yaml.safe_load(text)
        size = _expanded(value, {})
    except RecursionError as error:
        raise TooltipError(f"{source}: not YAML that can be read (nested too deeply)") from error
    # scalars such as 2020-99-99 reach constructors that raise ValueError, KeyError and others
    except Exception as error:
        raise TooltipError(f"{source}: not YAML ({' '.join(str(error).split())})") from error
    if size > _MAX_VALUES:
        raise TooltipError(
            f"{source}: not YAML that can be read (its aliases stand for more than {_MAX_VALUES} "
            "values, or for themselves)"
        )
    return value


def _expanded(value: Any, known: dict[int, float]) -> float:
    """Return how many values there are when every alias is written out; infinite in a circle."""
    if not isinstance(value, (dict, list, set, tuple)):
        return 1
    if id(value) not in known:
        known[id(value)] = float("inf")  # until it is known: a circle comes back to here
        items = [*value.keys(), *value.values()] if isinstance(value, dict) else value
        known[id(value)] = 1 + sum(_expanded(item, known) for item in items)
    return known[id(value)]


def shown(value: Any) -> str:
    """Return a short spelling of a value; aliases can make a whole one endless."""
    return " ".join(_SHORT.repr(value).split())
