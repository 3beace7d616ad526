"""Make the README's picture from the figures of a report: ``python docs/make_picture.py REPORT``.

    tooltip demo && python docs/make_picture.py demo/report --tool pliers

Left the prediction in a whole frame, right the same tool close up. Few colours keep it small.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image

PICTURE = Path(__file__).parent / "images" / "result.png"
_PANEL = (480, 360)  # pixels
_GAP = 8
_COLOURS = 224


def main() -> None:
    """Write the picture and say how large it is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("report", type=Path, help="directory of a report")
    parser.add_argument("--tool", default="pliers", help="which of its recordings")
    options = parser.parse_args()
    figures = options.report / "figures"
    width, height = _PANEL
    picture = Image.new("RGB", (2 * width + _GAP, height), "white")
    for left, kind in ((0, "prediction"), (width + _GAP, "closeup")):
        with Image.open(figures / f"{options.tool}-{kind}.png") as figure:
            picture.paste(figure.convert("RGB").resize(_PANEL, Image.Resampling.LANCZOS), (left, 0))
    PICTURE.parent.mkdir(exist_ok=True)
    # of the ways to choose colours, the one that keeps the few pixels of the green cross green
    few = picture.quantize(_COLOURS, method=Image.Quantize.MAXCOVERAGE)
    few.save(PICTURE, optimize=True)
    print(f"{PICTURE}: {PICTURE.stat().st_size / 1000:.0f} kB")  # noqa: T201  # for the person who runs it


if __name__ == "__main__":
    main()
