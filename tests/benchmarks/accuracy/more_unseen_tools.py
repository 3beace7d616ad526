"""A second set of tools that the product does not have, for ``unseen.py --set second``.

They were made after those of ``unseen_tools.py`` had shaped the search for ends, and differ from
them in kind. Each builder says which point is the tip, and why somebody who labels images would
click there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tooltip_cli.sources.sim.materials import (
    bristles,
    brushed,
    plastic,
    printed,
    rubber,
    striped,
    wood,
)
from tooltip_cli.sources.sim.mesh import (
    Floats,
    Mesh,
    bevelled,
    box,
    circle,
    loft,
    merged,
    moved,
    revolve,
    spline,
    superellipse,
    torus,
)
from tooltip_cli.sources.sim.tool import Tool

_ALONG = np.array([1.0, 0.0, 0.0])


def tweezers(rng: np.random.Generator) -> Tool:
    """Return tweezers, 17 cm, whose points are 3 mm apart; the tip is midway between them.

    Neither point reaches farther, and what tweezers hold lies between them.
    """
    x = (-0.062, -0.058, -0.030, 0.010, 0.050, 0.080, 0.104, 0.112)
    bow = (0.0008, 0.0012, 0.0040, 0.0058, 0.0056, 0.0040, 0.0020, 0.0017)
    broad = (0.0035, 0.0045, 0.0050, 0.0052, 0.0048, 0.0030, 0.0011, 0.0006)
    arms = [
        loft(
            [(at, side * y, 0) for at, y in zip(x, bow, strict=True)],
            [(0.0008, half) for half in broad],
            superellipse(16, 4.0),
            material=0,
        )
        for side in (-1.0, 1.0)
    ]
    return Tool(
        merged(arms),
        (brushed(rng, (180, 184, 190), 0.8),),
        np.array([0.112, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0064,
        half_width=0.0052,
        slide_m=0.006,
        spin_deg=(-60.0, 60.0),
    )


def comb(rng: np.random.Generator) -> Tool:
    """Return a brown comb with a handle; the tip is the middle of its far edge, 3 cm long.

    The edge is straight and square: its middle is where the comb ends.
    """
    handle = box((-0.025, 0, 0.001), (0.055, 0.0025, 0.0105), material=0, bevel=0.4)
    spine = box((0.080, 0, 0.011), (0.052, 0.0022, 0.0055), material=0, bevel=0.3)
    teeth = [
        loft([(x, 0, 0.008), (x, 0, -0.010), (x, 0, -0.014)],
             [(0.0007, 0.0018), (0.0007, 0.0018), (0.0003, 0.0010)],
             bevelled(0.3), material=0, up=(0.0, 1.0, 0.0))
        for x in np.arange(0.033, 0.126, 0.003)
    ]  # fmt: skip
    guards = [
        box((x, 0, 0.001), (0.0020, 0.0022, 0.0150), material=0, bevel=0.3) for x in (0.030, 0.1300)
    ]
    return Tool(
        merged([handle, spine, *teeth, *guards]),
        (plastic(rng, (92, 52, 26), gloss=70.0, wear=0.15),),
        np.array([0.132, 0.0, 0.0012]),
        _ALONG,
        half_depth=0.0025,
        half_width=0.0105,
        spin_deg=(-40.0, 40.0),
    )


def trowel(rng: np.random.Generator) -> Tool:
    """Return a bricklayer's trowel, a triangle on a cranked neck; the tip is its point."""
    handle = [(-0.066, 0.0090), (-0.062, 0.0125), (-0.020, 0.0115), (0.030, 0.0130),
              (0.048, 0.0105)]  # fmt: skip
    neck = spline(
        [(0.044, 0, 0), (0.066, 0, 0), (0.080, -0.008, 0), (0.086, -0.022, 0), (0.098, -0.028, 0)],
        16,
    )
    x = np.array([0.080, 0.084, 0.092, 0.098, 0.110, 0.150, 0.196, 0.200])
    half = np.array([0.004, 0.014, 0.033, 0.037, 0.035, 0.021, 0.0025, 0.0006])
    blade = loft(
        np.column_stack([x, np.full(8, -0.029), 0 * x]),
        np.column_stack([np.linspace(0.0010, 0.0006, 8), half]),
        superellipse(16, 8.0),
        material=2,
    )
    return Tool(
        merged(
            [
                revolve(handle, material=0),
                revolve([(0.046, 0.0108), (0.058, 0.0085)], material=1),
                loft(neck, np.full(16, 0.0045), circle(14), material=1),
                blade,
            ]
        ),
        (
            wood(rng, (176, 120, 62), gloss=40.0),
            brushed(rng, (120, 122, 126), 0.5),
            brushed(rng, (168, 170, 172), 0.6),
        ),
        np.array([0.200, -0.029, 0.0]),
        _ALONG,
        half_depth=0.0115,
        half_width=0.0115,
        tilt_deg=(0.0, 25.0),
        spin_deg=(-50.0, 50.0),
    )


def funnel(rng: np.random.Generator) -> Tool:
    """Return a blue funnel held by its spout; the tip is the middle of its mouth, 9 cm wide.

    It is a place in the air; but the mouth is where the funnel ends, and a circle's middle is
    easier to click than any point of its rim.
    """
    spout = [(-0.070, 0.0060), (-0.060, 0.0070), (0.0, 0.0090), (0.056, 0.0110)]
    wall = [(0.0100, 0.054), (0.0430, 0.112), (0.0430, 0.118), (0.0450, 0.118), (0.0450, 0.111),
            (0.0115, 0.052)]  # fmt: skip
    return Tool(
        merged(
            [
                revolve(spout, material=0),
                revolve([(0.052, 0.0095), (0.0565, 0.0095)], material=1),
                _shell(wall, material=0),
            ]
        ),
        (plastic(rng, (36, 84, 170), gloss=60.0), plastic(rng, (10, 16, 30))),
        np.array([0.118, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0090,
        half_width=0.0090,
        spin_deg=(-180.0, 180.0),
    )


def ruler(rng: np.random.Generator) -> Tool:
    """Return a yellow ruler, 30 cm; the tip is the middle of its far edge, 3 cm long."""
    return Tool(
        box((0.055, 0, 0), (0.150, 0.0014, 0.0150), material=0, bevel=0.2),
        (striped(rng, (222, 184, 74), (44, 38, 26), period_m=0.05, along=5, around=0, share=0.12),),
        np.array([0.205, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0014,
        half_width=0.0150,
        spin_deg=(-40.0, 40.0),
    )


def ladle(rng: np.random.Generator) -> Tool:
    """Return a full ladle whose bowl, 7.6 cm wide, hangs to the side; the tip is its lowest point.

    The bowl's mouth faces back to the hand, so that its bottom is what reaches farthest.
    """
    radius, rim = 0.038, 0.120
    handle = loft(
        spline([(-0.090, 0, 0), (0.0, 0, 0), (0.080, 0, 0), (0.110, 0, 0), (0.128, -0.003, 0)], 24),
        np.full((24, 2), (0.0012, 0.0065)),
        superellipse(18, 3.0),
        material=0,
    )
    turn = np.linspace(0.0, np.radians(84.0), 14)
    bowl = revolve(
        np.column_stack([radius * np.sin(turn), radius * np.cos(turn)]),
        material=0,
        sides=36,
        tip=float(radius * (1 - np.sin(turn[-1]))),
    )
    soup = revolve([(-0.0008, 0.0365), (0.0, 0.0365)], material=1, sides=36)
    hang = np.eye(4)
    hang[:3, 3] = (rim, -radius, 0.0)
    return Tool(
        merged([handle, moved(bowl, hang), moved(soup, hang)]),
        (brushed(rng, (198, 200, 204), 1.0), plastic(rng, (150, 78, 24), gloss=90.0)),
        np.array([rim + radius, -radius, 0.0]),
        _ALONG,
        half_depth=0.0012,
        half_width=0.0065,
        tilt_deg=(0.0, 25.0),
        spin_deg=(-40.0, 40.0),
    )


def key(rng: np.random.Generator) -> Tool:
    """Return an old brass key, 13 cm; the tip is the end face of its shaft, beyond its bit."""
    turn = np.linspace(0.0, 2.0 * np.pi, 29)[:-1]
    bow = np.column_stack([-0.016 + 0.014 * np.cos(turn), 0 * turn, 0.014 * np.sin(turn)])
    shaft = [(-0.003, 0.0040), (0.010, 0.0040), (0.060, 0.0040), (0.106, 0.0040), (0.108, 0.0034)]
    bit = [
        box((0.0925, 0, -0.008), (0.0095, 0.0016, 0.0060), material=0),
        box((0.0865, 0, -0.017), (0.0035, 0.0016, 0.0055), material=0),
        box((0.0985, 0, -0.017), (0.0035, 0.0016, 0.0055), material=0),
    ]
    return Tool(
        merged(
            [
                torus(bow, 0.0040, material=0),
                revolve(shaft, material=0, sides=20),
                revolve([(0.056, 0.0055), (0.062, 0.0055)], material=0, sides=20),
                *bit,
            ]
        ),
        (brushed(rng, (172, 132, 60), 0.5),),
        np.array([0.108, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0040,
        half_width=0.0120,
        slide_m=0.005,
        spin_deg=(-60.0, 60.0),
    )


def spray_can(rng: np.random.Generator) -> Tool:
    """Return a can with a nozzle of 13 mm; the tip is the middle of the nozzle's top.

    The nozzle is what reaches farthest, and where one presses.
    """
    can = [(-0.085, 0.0240), (-0.083, 0.0260), (-0.070, 0.0260), (0.0, 0.0260), (0.070, 0.0260)]
    dome = [(0.069, 0.0262), (0.073, 0.0262), (0.080, 0.0225), (0.085, 0.0170), (0.087, 0.0160),
            (0.0895, 0.0160), (0.0900, 0.0140)]  # fmt: skip
    nozzle = [(0.089, 0.0030), (0.094, 0.0030), (0.094, 0.0066), (0.104, 0.0064), (0.1055, 0.0052)]
    hole = loft([(0.100, -0.004, 0), (0.100, -0.0071, 0)], (0.0016, 0.0016), circle(12), material=3)
    return Tool(
        merged(
            [
                revolve(can, material=0, sides=36),
                revolve(dome, material=1, sides=36),
                revolve(nozzle, material=2, sides=24),
                hole,
            ]
        ),
        (
            printed(
                rng, (190, 34, 40), (250, 240, 220), (30, 30, 34), ("SIGNAL", "400 ml"),
                period_m=0.10,
            ),
            brushed(rng, (190, 192, 196), 0.9),
            plastic(rng, (236, 236, 232)),
            plastic(rng, (30, 30, 30)),
        ),
        np.array([0.1055, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0260,
        half_width=0.0260,
        slide_m=0.006,
        tilt_deg=(0.0, 28.0),
        spin_deg=(-180.0, 180.0),
    )  # fmt: skip


def dish_brush(rng: np.random.Generator) -> Tool:
    """Return a brush with a round head, 6.4 cm wide; the tip is the farthest point of its rim.

    Of the wooden rim, as the bristles point to the side.
    """
    handle = loft(
        [(x, 0, 0) for x in (-0.080, -0.076, 0.0, 0.050, 0.085, 0.100)],
        [(0.0045, 0.0070), (0.0065, 0.0100), (0.0070, 0.0095), (0.0065, 0.0085), (0.0050, 0.0065),
         (0.0048, 0.0080)],
        superellipse(22, 2.4), material=0,
    )  # fmt: skip
    middle = 0.125
    head = loft(
        [(middle, y, 0) for y in (0.0060, 0.0045, -0.0030, -0.0045)],
        (0.0300, 0.0320, 0.0320, 0.0300), circle(36), material=0,
    )  # fmt: skip
    tuft = loft(
        [(middle, y, 0) for y in (-0.004, -0.016, -0.028)],
        (0.0250, 0.0275, 0.0295), circle(32), material=1,
    )  # fmt: skip
    return Tool(
        merged([handle, head, tuft]),
        (wood(rng, (206, 160, 104), gloss=20.0), bristles(rng, (232, 228, 214))),
        np.array([middle + 0.032, 0.0008, 0.0]),
        _ALONG,
        half_depth=0.0070,
        half_width=0.0095,
        tilt_deg=(0.0, 25.0),
        spin_deg=(-60.0, 60.0),
    )


def syringe(rng: np.random.Generator) -> Tool:
    """Return a syringe with a needle of 1.2 mm, 4 cm long; the tip is the needle's point."""
    barrel = [(-0.046, 0.0090), (0.0, 0.0090), (0.066, 0.0090), (0.070, 0.0060), (0.074, 0.0025)]
    flange = box((-0.046, 0, 0), (0.0015, 0.0100, 0.0160), material=0)
    plunger: list[Mesh] = [
        box((-0.062, 0, 0), (0.018, 0.0010, 0.0060), material=0),
        box((-0.062, 0, 0), (0.018, 0.0060, 0.0010), material=0),
        revolve([(-0.082, 0.0090), (-0.079, 0.0090)], material=0),
    ]
    return Tool(
        merged(
            [
                revolve(barrel, material=1),
                revolve([(0.072, 0.0026), (0.076, 0.0036), (0.086, 0.0020)], material=2),
                revolve([(0.085, 0.0006), (0.122, 0.0006)], material=3, sides=10, tip=0.002),
                flange,
                *plunger,
            ]
        ),
        (
            plastic(rng, (214, 220, 222), gloss=60.0),
            striped(rng, (222, 228, 230), (60, 62, 70), period_m=0.02, along=4, share=0.12),
            rubber(rng, (40, 120, 80)),
            brushed(rng, (170, 172, 176), 0.7),
        ),
        np.array([0.124, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0090,
        half_width=0.0090,
        slide_m=0.006,
        spin_deg=(-180.0, 180.0),
    )


def _shell(profile: list[tuple[float, float]], *, material: int) -> Mesh:
    """Return what a clockwise polygon of (radius, x) sweeps about the x axis."""
    section: Floats = np.array(profile)
    middle = section[:, 0].mean()
    turn = np.linspace(0.0, 2.0 * np.pi * 41 / 40, 42)
    path = middle * np.column_stack([0 * turn, np.cos(turn), np.sin(turn)])
    inward = np.column_stack([middle - section[:, 0], section[:, 1]])
    return loft(path, np.ones(42), inward, material=material, up=_ALONG)


MORE_UNSEEN: dict[str, Callable[[np.random.Generator], Tool]] = {
    "tweezers": tweezers,
    "comb": comb,
    "trowel": trowel,
    "funnel": funnel,
    "ruler": ruler,
    "ladle": ladle,
    "key": key,
    "spray_can": spray_can,
    "dish_brush": dish_brush,
    "syringe": syringe,
}
