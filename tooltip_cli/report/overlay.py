"""Marks over a camera image: the same shapes as SVG, on top of the JPEG, and as PNG."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.report.charts import Drawing, escape

Image = npt.NDArray[np.uint8]

WHITE, BLACK, GREEN = "#ffffff", "#000000", "#22dd44"
_PRINT_WIDTH = 1280  # pixels of the PNG, 4.3 inches at 300 dots an inch
_PAGE_WIDTH = 720  # pixels of an image in the page
_SHIFT = 4  # OpenCV draws to a sixteenth of a pixel


@dataclass(frozen=True)
class Circle:
    """A ring, or a disc where ``filled``."""

    u: float
    v: float
    radius: float  # image pixels
    color: str
    width: float = 1.5  # image pixels
    filled: bool = False


@dataclass(frozen=True)
class Line:
    """A straight line."""

    u1: float
    v1: float
    u2: float
    v2: float
    color: str
    width: float = 1.5  # image pixels


Shape = Circle | Line


@dataclass(frozen=True)
class Window:
    """The part of an image that is shown: [left, left + width) and so on, pixels."""

    left: int
    top: int
    width: int
    height: int

    def cut(self, image: Image) -> Image:
        """Return that part of (H, W, 3)."""
        part = image[self.top : self.top + self.height, self.left : self.left + self.width]
        return np.ascontiguousarray(part)


def cross(
    u: float, v: float, size: float, color: str, width: float = 1.5, gap: float = 0.0
) -> list[Shape]:
    """Return a cross of this size, measured across, with a gap of that size in its middle."""
    half = size / 2
    arms = ((-half, -gap / 2), (gap / 2, half)) if gap else ((-half, half),)
    return [
        Line(u + near * du, v + near * dv, u + far * du, v + far * dv, color, width)
        for near, far in arms
        for du, dv in ((1, 0), (0, 1))
    ]


def whole(image: Image) -> Window:
    """Return the window that shows all of an image."""
    return Window(0, 0, image.shape[1], image.shape[0])


def window_around(points: npt.NDArray[np.float64], image: Image, least: int) -> Window:
    """Return a window, 4 wide to 3 high, that holds (N, 2) points with a margin.

    Args:
        image: which the window stays inside.
        least: smallest width, pixels.
    """
    height, width = image.shape[:2]
    low, high = points.min(axis=0), points.max(axis=0)
    across, down = 1.5 * (high - low)
    wide = int(min(max(least, across, down * 4 / 3), width, height * 4 / 3))
    size = np.array([wide, min(height, wide * 3 // 4)])
    left, top = np.clip(np.round((low + high - size) / 2), 0, (width, height) - size).astype(int)
    return Window(int(left), int(top), int(size[0]), int(size[1]))


def overlay_svg(
    image: Image,
    window: Window,
    shapes: Sequence[Shape],
    alt: str,
    quality: int,
    most: int | None = None,
) -> str:
    """Return an SVG of the window with its marks, everything embedded.

    Args:
        alt: the text alternative.
        quality: of the JPEG.
        most: largest width of the JPEG, pixels; larger windows are scaled down.
    """
    import cv2

    picture = window.cut(image)
    if most is not None and window.width > most:
        size = (most, round(window.height * most / window.width))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    _, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    data = base64.b64encode(jpeg.tobytes()).decode()
    box = f"{window.left - 0.5:g} {window.top - 0.5:g} {window.width} {window.height}"
    place = f'x="{window.left - 0.5:g}" y="{window.top - 0.5:g}"'
    marks = "".join(_svg(shape, casing) for casing in (True, False) for shape in shapes)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" role="img" '
        f'aria-label="{escape(alt)}"><image {place} width="{window.width}" '
        f'height="{window.height}" href="data:image/jpeg;base64,{data}"/>{marks}</svg>'
    )


def _svg(shape: Shape, casing: bool) -> str:
    color, extra = (_against(shape.color), 1.4) if casing else (shape.color, 0.0)
    stroke = f'stroke="{color}" stroke-width="{shape.width + extra:.2f}"'
    if isinstance(shape, Line):
        ends = f'x1="{shape.u1:.2f}" y1="{shape.v1:.2f}" x2="{shape.u2:.2f}" y2="{shape.v2:.2f}"'
        return f"<line {ends} {stroke}/>"
    place = f'cx="{shape.u:.2f}" cy="{shape.v:.2f}"'
    if shape.filled:
        return f'<circle {place} r="{shape.radius + extra / 2:.2f}" fill="{color}"/>'
    return f'<circle {place} r="{shape.radius:.2f}" fill="none" {stroke}/>'


def _against(color: str) -> str:
    """Return the colour of the casing that keeps a mark visible on any background."""
    return WHITE if color == BLACK else BLACK


def overlay_png(image: Image, window: Window, shapes: Sequence[Shape]) -> bytes:
    """Return the same as a PNG of print width."""
    import cv2

    scale = max(1.0, _PRINT_WIDTH / window.width)
    size = (round(window.width * scale), round(window.height * scale))
    picture = cv2.resize(window.cut(image), size, interpolation=cv2.INTER_CUBIC)
    for casing in (True, False):
        for shape in shapes:
            _paint(cv2, picture, window, scale, shape, casing)
    _, png = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return png.tobytes()


def _paint(
    cv2: Any, picture: Image, window: Window, scale: float, shape: Shape, casing: bool
) -> None:
    color, extra = (_against(shape.color), 1.4) if casing else (shape.color, 0.0)
    bgr = tuple(int(color[i : i + 2], 16) for i in (5, 3, 1))
    thick = max(1, round((shape.width + extra) * scale))

    def fixed(u: float, v: float) -> tuple[int, int]:
        # the window's first pixel centre lies half a scaled pixel inside the picture
        place = ((u - window.left + 0.5) * scale - 0.5, (v - window.top + 0.5) * scale - 0.5)
        return round(place[0] * 2**_SHIFT), round(place[1] * 2**_SHIFT)

    if isinstance(shape, Line):
        ends = (fixed(shape.u1, shape.v1), fixed(shape.u2, shape.v2))
        cv2.line(picture, *ends, bgr, thick, cv2.LINE_AA, _SHIFT)
        return
    radius = round((shape.radius + (extra / 2 if shape.filled else 0)) * scale * 2**_SHIFT)
    center = fixed(shape.u, shape.v)
    thick = -1 if shape.filled else thick
    cv2.circle(picture, center, radius, bgr, thick, cv2.LINE_AA, _SHIFT)


def drawing(
    name: str,
    title: str,
    alt: str,
    caption: str,
    image: Image,
    window: Window,
    shapes: Sequence[Shape],
    data: str,
) -> Drawing:
    """Return marks over an image as a figure; the page's copy is compressed more."""
    return Drawing(
        name,
        title,
        alt,
        caption,
        overlay_svg(image, window, shapes, alt, 92).encode(),
        overlay_png(image, window, shapes),
        data,
        overlay_svg(image, window, shapes, alt, 72, most=_PAGE_WIDTH),
    )
