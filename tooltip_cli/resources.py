"""Files that are installed beside the code: message definitions and reference rigs."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).parent


def resource(*parts: str) -> Path:
    """Return the path of an installed data file, e.g. ``resource("calib", "bench", "rig.yaml")``.

    A wheel carries ``schemas`` and ``calib`` inside the package; an editable install and a
    checkout have them beside it.

    Raises:
        FileNotFoundError: neither place holds it, which means a broken installation.
    """
    for root in (_PACKAGE, _PACKAGE.parent):
        path = root.joinpath(*parts)
        if path.exists():
            return path
    raise FileNotFoundError(f"{'/'.join(parts)} is missing from the installation of tooltip-cli")
