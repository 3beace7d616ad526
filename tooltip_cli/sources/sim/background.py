"""What stands behind the robot: photographs or procedural clutter, on a plane far away."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tooltip_cli.errors import MissingExtraError, TooltipError
from tooltip_cli.sources.sim.bench import Intrinsics
from tooltip_cli.sources.sim.mesh import Floats

Image = NDArray[np.float32]

DISTANCE_M = 2.5  # of the plane from the camera
PHOTOGRAPHS = {
    "motorcycle": "motorcycle_left.png",
    "astronaut": "astronaut.png",
    "coffee": "coffee.png",
    "chelsea": "chelsea.png",
}
_PAINTS = np.array(
    [
        (0.45, 0.36, 0.27), (0.62, 0.52, 0.40), (0.30, 0.22, 0.16), (0.72, 0.70, 0.66),
        (0.50, 0.50, 0.50), (0.22, 0.23, 0.25), (0.12, 0.12, 0.13), (0.30, 0.38, 0.46),
        (0.20, 0.28, 0.42), (0.34, 0.40, 0.28), (0.55, 0.22, 0.16), (0.70, 0.56, 0.24),
    ]
)  # fmt: skip
"""sRGB of what stands about: wood, cardboard, plaster, metal, cloth, paint."""
AUTO = ("motorcycle", "astronaut", "coffee", "clutter")


def backdrop(name: str, size: tuple[int, int], rng: np.random.Generator) -> Image:
    """Return (height, width, 3) float32 linear RGB of at least the given (width, height).

    Args:
        name: a photograph, ``clutter`` or ``auto``.
        size: pixels to cover; a photograph is scaled and cut, never stretched.
        rng: chooses the photograph, the part of it that is shown, and its side.

    Raises:
        MissingExtraError: scikit-image is absent.
        TooltipError: the installed scikit-image does not hold the photograph.
    """
    chosen = str(rng.choice(AUTO)) if name == "auto" else name
    image = clutter(size, rng) if chosen == "clutter" else _photograph(chosen)
    height, width = image.shape[:2]
    scale = max(size[0] / width, size[1] / height)
    wanted = (max(size[0], round(width * scale)), max(size[1], round(height * scale)))
    shrink = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
    scaled = cv2.resize(image, wanted, interpolation=shrink)
    left = round(float(rng.random()) * (wanted[0] - size[0]))
    top = round(float(rng.random()) * (wanted[1] - size[1]))
    part = scaled[top : top + size[1], left : left + size[0]]
    if rng.random() < 0.5:
        part = part[:, ::-1]
    return decoded(part)


def decoded(image: NDArray[np.uint8]) -> Image:
    """Return (h, w, 3) sRGB bytes as linear light, float32."""
    level = np.arange(256) / 255.0
    table = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return np.ascontiguousarray(table.astype(np.float32)[image])


def clutter(size: tuple[int, int], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return (height, width, 3) sRGB: overlapping things of all sizes, lit from above.

    Things that hide one another and whose sizes follow an inverse cube law give an image the
    power spectrum and the edges of photographs ("dead leaves": Lee, Mumford and Huang 2001).
    """
    width, height = size
    canvas = np.full((height, width, 3), 0.3, dtype=np.float32)
    smallest, largest = 0.02 * width, 0.30 * width
    grain = _grain((2 * width, 2 * height), rng, 9)  # things cut their texture out of it
    for _ in range(900):
        share = float(rng.random())
        radius = (smallest**-2 + share * (largest**-2 - smallest**-2)) ** -0.5
        _leaf(canvas, grain, rng, radius)
    light = 1.0 + 0.5 * _grain(size, rng, 1) + np.linspace(0.25, -0.15, height)[:, None]
    canvas *= np.clip(light, 0.3, 1.25)[..., None].astype(np.float32)
    canvas = cv2.GaussianBlur(canvas, (0, 0), 0.0009 * width)  # beyond the focus
    return np.asarray(np.clip(canvas * 255.0 + 0.5, 0, 255), dtype=np.uint8)


def seen_background(texture: Image, camera: Intrinsics, camera_from_nominal: Floats) -> Image:
    """Return the (h, w, 3) background that a camera sees near its nominal pose.

    Args:
        texture: backdrop, centred on the nominal camera's image.
        camera: intrinsics.
        camera_from_nominal: (4, 4) rigid transform between the camera's poses.
    """
    rows, columns = texture.shape[:2]
    margin = np.array([[1.0, 0.0, 0.5 * (columns - camera.width)],
                       [0.0, 1.0, 0.5 * (rows - camera.height)], [0.0, 0.0, 1.0]])  # fmt: skip
    # Points X on the plane z = d of the nominal camera move to R X + t = (R + t n' / d) X.
    plane = camera_from_nominal[:3, :3].copy()
    plane[:, 2] += camera_from_nominal[:3, 3] / DISTANCE_M
    pixel_from_texture = (
        camera.matrix @ plane @ np.linalg.inv(camera.matrix) @ np.linalg.inv(margin)
    )
    warped = cv2.warpPerspective(
        texture,
        pixel_from_texture,
        (camera.width, camera.height),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )
    return np.asarray(warped, dtype=np.float32)


def _photograph(name: str) -> NDArray[np.uint8]:
    """Return one of scikit-image's photographs as (h, w, 3) sRGB, from the installed files.

    The files are read from where they are installed, because scikit-image's own loaders would
    download what a version does not ship.
    """
    spec = importlib.util.find_spec("skimage")
    if spec is None or not spec.submodule_search_locations:
        raise MissingExtraError(f"the background '{name}'", "sim", "scikit-image")
    path = Path(spec.submodule_search_locations[0], "data", PHOTOGRAPHS[name])
    data = np.fromfile(path, dtype=np.uint8) if path.is_file() else np.empty(0, dtype=np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if image is None:
        raise TooltipError(
            f"the installed scikit-image has no photograph {path}; expected it beside the code: "
            "choose the background 'clutter' or reinstall scikit-image"
        )
    return np.ascontiguousarray(image[..., ::-1])


def _grain(size: tuple[int, int], rng: np.random.Generator, octaves: int = 8) -> Image:
    """Return (height, width) noise within about +-1: octaves from the coarsest, each half as
    strong as the one before."""
    total = np.zeros((size[1], size[0]), dtype=np.float32)
    for octave in range(octaves):
        cells = 3 * 2**octave
        white = rng.standard_normal((cells, cells)).astype(np.float32)
        total += 0.72**octave * cv2.resize(white, size, interpolation=cv2.INTER_CUBIC)
    return total / 3.0


def _leaf(canvas: Image, grain: Image, rng: np.random.Generator, radius: float) -> None:
    """Paint one thing, a box, a disc or a shard, over its shadow."""
    height, width = canvas.shape[:2]
    centre = rng.uniform((-0.1 * width, -0.1 * height), (1.1 * width, 1.1 * height))
    angle = float(rng.normal(0.0, 0.12)) if rng.random() < 0.75 else float(rng.uniform(0, np.pi))
    kind = float(rng.random())
    if kind < 0.6:
        outline = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
    else:
        corners = 40 if kind < 0.85 else 6
        turn = np.sort(rng.uniform(0, 2 * np.pi, corners))
        outline = np.column_stack([np.cos(turn), np.sin(turn)])
    c, s = np.cos(angle), np.sin(angle)
    shape = radius * (outline * (1.0, rng.uniform(0.25, 1.0))) @ np.array([[c, s], [-s, c]])
    paint = _PAINTS[int(rng.integers(len(_PAINTS)))] * np.clip(rng.normal(1.0, 0.05, 3), 0.8, 1.2)
    colour = np.clip(paint * np.clip(rng.lognormal(-0.15, 0.4), 0.2, 1.5), 0.02, 0.97)

    corner = np.floor(centre + 1.3 * np.minimum(shape.min(axis=0), 0.0)).astype(int)
    left, top = np.maximum(corner, 0)
    right, bottom = np.ceil(centre + 1.3 * np.maximum(shape.max(axis=0), 0.0)).astype(int)
    part = canvas[top : max(bottom, 0), left : max(right, 0)]
    if part.size == 0:
        return
    points = shape + centre - (left, top)
    part *= (1.0 - 0.7 * _mask(part, points + np.array([0.04, 0.09]) * radius))[..., None]
    rows, columns = part.shape[:2]
    i, j = rng.integers(0, (grain.shape[0] - rows + 1, grain.shape[1] - columns + 1))
    own = grain[i : i + rows, j : j + columns]
    slope = np.linspace(-1, 1, rows)[:, None] * float(rng.normal(-0.08, 0.12)) + np.linspace(
        -1, 1, columns
    )[None, :] * float(rng.normal(0.0, 0.15))
    surface = (
        colour * np.clip(1.0 + float(rng.uniform(0.15, 0.7)) * own + slope, 0.2, 1.9)[..., None]
    )
    cover = _mask(part, points)[..., None]
    part *= 1.0 - cover
    part += (cover * surface).astype(np.float32)


def _mask(part: Image, points: Floats) -> Image:
    """Return (h, w) the coverage of a polygon, 0 to 1, with smooth edges."""
    mask = np.zeros(part.shape[:2], dtype=np.uint8)
    fixed = np.round(points * 16.0).astype(np.int32).reshape(-1, 1, 2)
    cv2.fillPoly(mask, [fixed], (255,), lineType=cv2.LINE_AA, shift=4)
    return np.asarray(mask / np.float32(255.0), dtype=np.float32)
