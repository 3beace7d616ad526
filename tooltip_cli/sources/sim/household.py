"""Tools of a household: bottle, plug, brush, pen, scissors; see ``tool.py`` for the frame."""

from __future__ import annotations

import numpy as np

from tooltip_cli.sources.sim.materials import bristles, brushed, plastic, printed, striped, wood
from tooltip_cli.sources.sim.mesh import (
    Mesh,
    bevelled,
    box,
    capsule,
    circle,
    loft,
    merged,
    revolve,
    spline,
    superellipse,
    torus,
)
from tooltip_cli.sources.sim.tool import Tool


def bottle(rng: np.random.Generator) -> Tool:
    """Return a small bottle; the tip is the middle of its cap."""
    label, glass, cap = range(3)
    lower = [(-0.070, 0.023), (-0.067, 0.0265), (-0.050, 0.0270), (-0.034, 0.0270)]
    sleeve = [(-0.034, 0.0274), (0.0, 0.0274), (0.034, 0.0274), (0.062, 0.0274)]
    upper = [
        (0.062, 0.0270), (0.074, 0.0260), (0.088, 0.0215), (0.100, 0.0160), (0.110, 0.0130),
        (0.122, 0.0125), (0.124, 0.0150), (0.126, 0.0150), (0.128, 0.0125), (0.131, 0.0125),
    ]  # fmt: skip
    lid = [(0.129, 0.0148), (0.1445, 0.0146), (0.147, 0.0132)]
    return Tool(
        merged(
            [
                revolve(lower, material=glass, sides=32),
                revolve(sleeve, material=label, sides=32),
                revolve(upper, material=glass, sides=32),
                revolve(lid, material=cap, sides=32),
            ]
        ),
        (
            printed(
                rng, (236, 232, 214), (30, 36, 60), (24, 92, 60), ("MINERAL", "0.3 L"),
                period_m=0.096,
            ),
            plastic(rng, (44, 96, 62), gloss=90.0, specular=0.08),
            striped(rng, (226, 226, 220), (176, 176, 170), period_m=0.12, around=28),
        ),
        np.array([0.147, 0.0, 0.0]),
        np.array([1.0, 0.0, 0.0]),
        half_depth=0.0274,
        half_width=0.0274,
        tilt_deg=(5.0, 32.0),
        spin_deg=(-180.0, 180.0),
    )  # fmt: skip


def electrical_plug(rng: np.random.Generator) -> Tool:
    """Return a three-pin plug on a piece of cord."""
    body, ribs, pin = range(3)
    moulding = loft(
        [(x, 0, 0) for x in (-0.004, 0.020, 0.038, 0.052, 0.074, 0.078)],
        [(0.0085, 0.0085), (0.0105, 0.0100), (0.0120, 0.0115), (0.0150, 0.0135), (0.0165, 0.0145),
         (0.0155, 0.0135)],
        superellipse(28, 3.2),
        material=body,
    )  # fmt: skip
    relief = revolve([(-0.040, 0.0060), (-0.022, 0.0072), (-0.002, 0.0088)], material=ribs)
    cord = spline(
        [(-0.036, 0, 0), (-0.062, 0.002, -0.004), (-0.092, 0.012, -0.02), (-0.122, 0.03, -0.03)], 24
    )
    blades = [
        box((0.0855, side * 0.0064, -0.004), (0.0090, 0.0008, 0.0032), material=pin)
        for side in (-1.0, 1.0)
    ]
    # The earth pin is the longest of the three: its end is the tip.
    earth = loft(
        [(0.076, 0, 0.0075), (0.094, 0, 0.0075), (0.0975, 0, 0.0075), (0.0992, 0, 0.0075)],
        (0.0024, 0.0024, 0.0019, 0.0010),
        circle(16),
        material=pin,
        bulge=(0.0, 0.0003),
    )
    ivory = (206, 198, 176)
    return Tool(
        merged([moulding, relief, capsule(cord, 0.0042, material=ribs, sides=12), *blades, earth]),
        (
            plastic(rng, ivory, gloss=20.0),
            striped(rng, ivory, (120, 114, 100), period_m=0.016, along=4, share=0.3),
            brushed(rng, (206, 180, 110), 0.8),
        ),
        np.array([0.0995, 0.0, 0.0075]),
        np.array([1.0, 0.0, 0.0]),
        half_depth=0.0095,
        half_width=0.0095,
        slide_m=0.006,
        tilt_deg=(5.0, 32.0),
    )


def paint_brush(rng: np.random.Generator) -> Tool:
    """Return a flat brush, 23 cm; the tip is the middle of its edge."""
    handle, ferrule, hair, stain = range(4)
    grip = loft(
        [(x, 0, 0) for x in (-0.085, -0.080, -0.055, -0.02, 0.02, 0.045, 0.062)],
        [(0.005, 0.007), (0.006, 0.0095), (0.0075, 0.0125), (0.0070, 0.0090), (0.0075, 0.0105),
         (0.0085, 0.0200), (0.0085, 0.0240)],
        superellipse(28, 2.4),
        material=handle,
    )  # fmt: skip
    band = loft(
        [(x, 0, 0) for x in (0.056, 0.058, 0.090, 0.092)],
        [(0.0095, 0.0250), (0.0100, 0.0255), (0.0100, 0.0255), (0.0090, 0.0245)],
        superellipse(32, 5.0),
        material=ferrule,
    )
    tuft = loft(
        [(x, 0, 0) for x in (0.088, 0.100, 0.120)],
        [(0.0090, 0.0245), (0.0095, 0.0255), (0.0080, 0.0262)],
        superellipse(32, 4.0),
        material=hair,
    )
    end = loft(
        [(x, 0, 0) for x in (0.119, 0.132, 0.141, 0.145)],
        [(0.0081, 0.0262), (0.0062, 0.0255), (0.0040, 0.0245), (0.0022, 0.0230)],
        superellipse(32, 4.0),
        material=stain,
    )
    return Tool(
        merged([grip, band, tuft, end]),
        (
            wood(rng, (186, 120, 58), gloss=60.0),
            brushed(rng, (190, 186, 176)),
            bristles(rng, (60, 44, 30)),
            bristles(rng, (70, 52, 40)),
        ),
        np.array([0.145, 0.0, 0.0]),
        np.array([1.0, 0.0, 0.0]),
        half_depth=0.0075,
        half_width=0.0105,
        spin_deg=(-35.0, 35.0),
    )


def pen(rng: np.random.Generator) -> Tool:
    """Return a ball pen, 17 cm."""
    barrel, trim, point, sleeve = range(4)
    body = [(-0.052, 0.0052), (-0.050, 0.0058), (0.0, 0.0060), (0.050, 0.0058), (0.064, 0.0056)]
    grip = [(0.063, 0.0059), (0.065, 0.0062), (0.086, 0.0058), (0.090, 0.0050)]
    cone = [(0.089, 0.0048), (0.096, 0.0034), (0.1010, 0.0018), (0.1015, 0.0012), (0.1045, 0.0009)]
    knob = revolve([(-0.065, 0.0030), (-0.063, 0.0036), (-0.051, 0.0036)], material=trim, sides=16)
    clip = box((-0.030, -0.0075, 0.0), (0.021, 0.0010, 0.0022), material=trim)
    ring = revolve([(-0.0505, 0.0063), (-0.0465, 0.0063)], material=trim)
    return Tool(
        merged(
            [
                revolve(body, material=barrel, sides=24),
                revolve(grip, material=sleeve, sides=24),
                revolve(cone, material=point, sides=20, tip=0.0008),
                knob,
                clip,
                ring,
            ]
        ),
        (
            plastic(rng, (22, 44, 118), gloss=90.0),
            brushed(rng, (200, 202, 206), 0.9),
            brushed(rng, (188, 188, 190), 0.8),
            striped(rng, (26, 26, 30), (48, 48, 54), period_m=0.024, along=6),
        ),
        np.array([0.1053, 0.0, 0.0]),
        np.array([1.0, 0.0, 0.0]),
        half_depth=0.0060,
        half_width=0.0060,
        slide_m=0.004,
        spin_deg=(-180.0, 180.0),
    )


def scissors(rng: np.random.Generator) -> Tool:
    """Return closed scissors, 20 cm, held by the rings."""
    steel, grip, screw = range(3)
    parts: list[Mesh] = []
    for side in (-1.0, 1.0):
        turn = np.linspace(0.0, 2.0 * np.pi, 33)[:-1]
        ring = np.column_stack(
            [-0.030 + 0.030 * np.cos(turn), 0 * turn, side * (0.0175 + 0.0125 * np.sin(turn))]
        )
        parts.append(torus(ring, 0.0044, material=grip))
        shank = spline([(-0.002, 0, side * 0.014), (0.022, 0, side * 0.009), (0.046, 0, 0)], 12)
        parts.append(
            loft(shank, np.full((12, 2), (0.0052, 0.0036)), superellipse(16, 2.6),
                 material=grip, up=(0.0, 1.0, 0.0))
        )  # fmt: skip
        x = (0.034, 0.050, 0.070, 0.100, 0.128, 0.1395)
        w = np.array((0.0050, 0.0082, 0.0078, 0.0058, 0.0030, 0.0010))
        y = side * 0.0011
        parts.append(
            loft([(a, y, 0.35 * side * b) for a, b in zip(x, w, strict=True)],
                 [(0.0011, b) for b in w], bevelled(0.5), material=steel, bulge=(0.0, 0.0004))
        )  # fmt: skip
    pivot = loft(
        [(0.056, -0.0042, 0), (0.056, -0.0036, 0), (0.056, 0.0036, 0), (0.056, 0.0042, 0)],
        (0.0034, 0.0042, 0.0042, 0.0034), circle(16), material=screw,
    )  # fmt: skip
    point = box((0.1388, 0.0, 0.0), (0.0011, 0.0016, 0.0008), material=steel)
    return Tool(
        merged([*parts, pivot, point]),
        (
            brushed(rng, (186, 188, 192), 0.9),
            plastic(rng, (224, 110, 24), gloss=50.0),
            brushed(rng, (120, 120, 124), 0.5),
        ),
        np.array([0.1399, 0.0, 0.0]),
        np.array([1.0, 0.0, 0.0]),
        half_depth=0.0052,
        half_width=0.0250,
        slide_m=0.006,
        spin_deg=(-20.0, 20.0),
    )
