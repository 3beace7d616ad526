"""Surfaces: procedural textures and how they reflect light."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tooltip_cli.sources.sim.mesh import Floats

_ROWS, _COLUMNS = 128, 256  # texture size: turns round the part, length along it


@dataclass(frozen=True)
class Material:
    """A textured surface.

    ``texture`` is (h, w, 4) float32: linear RGB reflectance and a factor on the gloss; its rows
    go round the part and its columns along it.
    """

    texture: NDArray[np.float32]
    period_m: float  # length of surface that the columns cover
    specular: float  # reflectance at normal incidence
    exponent: float  # sharpness of the highlight (Blinn-Phong)
    metal: float  # 0: coloured by diffuse light; 1: colours its reflections
    mirror: float  # 0: reflects a blurred room, 1: a clear one


def linear(rgb: tuple[int, int, int]) -> Floats:
    """Return an sRGB colour (0..255) as linear reflectance."""
    value = np.array(rgb, dtype=np.float64) / 255.0
    low = value / 12.92
    return np.where(value <= 0.04045, low, ((value + 0.055) / 1.055) ** 2.4)


def speckle(rng: np.random.Generator, stretch: tuple[float, float], octaves: int = 4) -> Floats:
    """Return tileable noise of mean 0 and deviation 1, (rows, columns), with a 1/f spectrum.

    Args:
        rng: source of randomness.
        stretch: features are longer by these factors (round, along).
        octaves: how many octaves of scales it holds.
    """
    fy = np.fft.fftfreq(_ROWS)[:, None] * stretch[0]
    fx = np.fft.rfftfreq(_COLUMNS)[None, :] * stretch[1]
    frequency = np.hypot(fx, fy)
    lowest = 0.25 * 2.0**-octaves
    amplitude = 1.0 / np.maximum(frequency, lowest)
    amplitude[frequency < 0.5 * lowest] = 0.0
    amplitude[0, 0] = 0.0
    white = np.fft.rfft2(rng.standard_normal((_ROWS, _COLUMNS)))
    noise = np.fft.irfft2(white * amplitude, s=(_ROWS, _COLUMNS))
    return np.asarray(noise / noise.std(), dtype=np.float64)


def plastic(
    rng: np.random.Generator,
    rgb: tuple[int, int, int],
    *,
    gloss: float = 40.0,
    specular: float = 0.04,
    wear: float = 0.06,
) -> Material:
    """A moulded part: nearly even colour, faint stains, scuffs that take the gloss away."""
    stain = 1.0 + wear * speckle(rng, (1.0, 1.0))
    scuff = np.clip(1.0 - 0.35 * np.abs(speckle(rng, (0.6, 3.0))), 0.2, 1.0)
    return Material(_layers(linear(rgb), stain, scuff), 0.12, specular, gloss, 0.0, 0.4)


def rubber(rng: np.random.Generator, rgb: tuple[int, int, int]) -> Material:
    """A matt, dusty part."""
    dust = 1.0 + 0.12 * speckle(rng, (1.0, 1.0), 5)
    return Material(_layers(linear(rgb), dust, np.ones_like(dust)), 0.08, 0.03, 8.0, 0.0, 0.0)


def brushed(
    rng: np.random.Generator, rgb: tuple[int, int, int] = (176, 178, 182), mirror: float = 0.5
) -> Material:
    """Bare metal with fine scratches along the part."""
    scratch = 1.0 + 0.10 * speckle(rng, (0.5, 8.0)) + 0.05 * speckle(rng, (1.0, 1.0))
    gloss = np.clip(1.0 - 0.3 * np.abs(speckle(rng, (0.5, 8.0))), 0.1, 1.0)
    return Material(_layers(linear(rgb), scratch, gloss), 0.10, 0.5, 60.0, 0.85, mirror)


def wood(rng: np.random.Generator, rgb: tuple[int, int, int], gloss: float = 25.0) -> Material:
    """Grain along the part, a few darker rings and a dull varnish."""
    grain = 0.14 * speckle(rng, (0.7, 12.0)) + 0.10 * speckle(rng, (2.0, 6.0), 3)
    vessels = np.where(speckle(rng, (0.4, 9.0), 3) > 1.8, -0.3, 0.0)
    factor = np.clip(1.0 + grain + vessels, 0.3, 1.6)
    return Material(_layers(linear(rgb), factor, np.ones_like(factor)), 0.16, 0.04, gloss, 0.0, 0.2)


def striped(
    rng: np.random.Generator,
    first: tuple[int, int, int],
    second: tuple[int, int, int],
    *,
    period_m: float,
    along: int = 0,
    around: int = 0,
    share: float = 0.5,
) -> Material:
    """Ribs: ``along`` stripes per period cross the part, ``around`` stripes run along it."""
    material = plastic(rng, first, wear=0.08)
    column = np.arange(_COLUMNS)[None, :] / _COLUMNS * along
    row = np.arange(_ROWS)[:, None] / _ROWS * around
    mask = np.zeros((_ROWS, _COLUMNS), dtype=bool)
    if along:
        mask |= (column % 1.0) < share
    if around:
        mask |= (row % 1.0) < share
    other = plastic(rng, second, wear=0.08).texture
    texture = np.where(mask[..., None], other, material.texture).astype(np.float32)
    return Material(texture, period_m, 0.04, 25.0, 0.0, 0.2)


def bristles(rng: np.random.Generator, rgb: tuple[int, int, int]) -> Material:
    """Hairs along the part: dark gaps between lighter strands."""
    strand = 1.0 + 0.35 * speckle(rng, (0.35, 14.0), 3) + 0.12 * speckle(rng, (1.5, 4.0))
    factor = np.clip(strand, 0.25, 1.8)
    return Material(_layers(linear(rgb), factor, np.ones_like(factor)), 0.12, 0.05, 12.0, 0.0, 0.0)


def printed(
    rng: np.random.Generator,
    rgb: tuple[int, int, int],
    ink: tuple[int, int, int],
    band: tuple[int, int, int],
    words: tuple[str, ...],
    *,
    period_m: float,
) -> Material:
    """A label: a coloured band, words and small print, running along the part."""
    canvas = np.empty((_ROWS * 4, _COLUMNS * 4, 3), dtype=np.uint8)
    canvas[:] = rgb
    rows, columns = canvas.shape[:2]
    cv2.rectangle(canvas, (0, int(0.08 * rows)), (columns, int(0.40 * rows)), band, -1)
    for index, word in enumerate(words):
        origin = (int(0.05 * columns), int((0.32 + 0.5 * index) * rows))
        cv2.putText(
            canvas, word, origin, cv2.FONT_HERSHEY_DUPLEX, 4.6, rgb if index == 0 else ink, 10
        )
    for row in range(int(0.48 * rows), int(0.95 * rows), 22):
        start = 0.62 + 0.05 * float(rng.random())
        length = 0.10 + 0.22 * float(rng.random())
        cv2.line(
            canvas,
            (int(start * columns), row),
            (int((start + length) * columns), row),
            ink,
            6,
        )
    small = cv2.resize(canvas, (_COLUMNS, _ROWS), interpolation=cv2.INTER_AREA)
    table = np.array([linear((level, level, level))[0] for level in range(256)])
    factor = 1.0 + 0.04 * speckle(rng, (1.0, 1.0))
    texture = np.concatenate(
        [table[small] * factor[..., None], np.ones((*factor.shape, 1))], axis=2
    )
    return Material(texture.astype(np.float32), period_m, 0.04, 60.0, 0.0, 0.6)


def _layers(colour: Floats, factor: Floats, gloss: Floats) -> NDArray[np.float32]:
    rgb = np.clip(colour[None, None, :] * factor[..., None], 0.002, 0.95)
    return np.concatenate([rgb, gloss[..., None]], axis=2).astype(np.float32)
