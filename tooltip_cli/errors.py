"""The failures that users can cause and mend; anyone may import this module."""

from __future__ import annotations

from collections.abc import Iterable


class TooltipError(Exception):
    """An expected failure: the message names what was found, what was expected and what to do."""

    exit_code = 1


class MissingExtraError(TooltipError):
    """A command needs packages of an extra that is not installed.

    Args:
        feature: what the user asked for, e.g. ``record bag``.
        extra: name of the extra in this package's metadata.
        module: the module that could not be imported.
    """

    def __init__(self, feature: str, extra: str, module: str) -> None:
        super().__init__(
            f"{feature} needs the package '{module}', which is not installed: "
            f"pip install 'tooltip-cli[{extra}]'"
        )


class DamagedLogError(TooltipError):
    """An MCAP file that is truncated or fails a checksum; nothing damaged was read."""


class LowDiskError(TooltipError):
    """Recording stopped before the disk was full; everything before is written."""


class StoppedError(TooltipError):
    """Work ended early because somebody asked for it; what was done so far is kept."""


class RefusedError(TooltipError):
    """No trustworthy answer exists in this data; the message says why (exit code 3)."""

    exit_code = 3


def one_of(kind: str, name: str, known: Iterable[object]) -> str:
    """Return the sentence for an unknown name: what was given and the valid names."""
    names = ", ".join(sorted(str(item) for item in known))
    return f"unknown {kind} '{name}'; known: {names}"
