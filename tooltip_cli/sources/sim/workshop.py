"""Tools of a workshop: hot-glue gun, screwdriver, pliers, hammer; see ``tool.py`` for the frame."""

from __future__ import annotations

import numpy as np

from tooltip_cli.sources.sim.materials import brushed, plastic, rubber, striped, wood
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
)
from tooltip_cli.sources.sim.tool import Tool


def hot_glue_gun(rng: np.random.Generator) -> Tool:
    """Return a pistol whose nozzle points along the fingers."""
    shell, dark, accent, brass, stick, label = range(6)
    up, x = (1.0, 0.0, 0.0), 0.066  # the barrel runs along z, across the handle's upper end
    body = loft(
        [(x + 0.006, 0, -0.058), (x + 0.006, 0, -0.053), (x + 0.003, 0, -0.030), (x, 0, 0.020),
         (x, 0, 0.056), (x, 0, 0.060)],
        [(0.010, 0.009), (0.014, 0.012), (0.0175, 0.018), (0.0165, 0.019), (0.015, 0.016),
         (0.0135, 0.0145)],
        superellipse(28, 3.6), material=shell, up=up,
    )  # fmt: skip
    shield = loft(
        [(x, 0.0, z) for z in (0.058, 0.061, 0.082, 0.092, 0.094)],
        (0.0128, 0.0138, 0.0128, 0.0108, 0.0098), circle(24), material=dark, up=up,
    )  # fmt: skip
    slots = [
        box((x + 0.007, 0.0, z), (0.0012, 0.0133, 0.0016), material=brass)
        for z in (0.066, 0.072, 0.078)
    ]
    nozzle = loft(
        [(x, 0.0, z) for z in (0.092, 0.102, 0.104, 0.110, 0.112, 0.124)],
        (0.0085, 0.0085, 0.0065, 0.0065, 0.0050, 0.0020), circle(20), material=brass, up=up,
    )  # fmt: skip
    handle = loft(
        [(0.060, 0, 0.004), (0.034, 0, 0.001), (0, 0, 0), (-0.035, 0, -0.004), (-0.05, 0, -0.006)],
        [(0.014, 0.021), (0.0135, 0.017), (0.0135, 0.0165), (0.0135, 0.018), (0.012, 0.016)],
        superellipse(24, 3.0), material=dark,
    )  # fmt: skip
    trigger = box((0.036, 0.0, 0.024), (0.013, 0.005, 0.009), material=accent, bevel=0.4)
    plate = box((x + 0.002, 0.0, -0.006), (0.0095, 0.0184, 0.024), material=label, bevel=0.05)
    seam = box((x + 0.0165, 0.0, 0.0), (0.0015, 0.0012, 0.046), material=dark)
    feed = loft(
        [(x, 0, -0.105), (x, 0, -0.052)], (0.0056, 0.0056), circle(16), material=stick, up=up
    )
    cord = spline([(-0.048, 0, -0.006), (-0.075, 0.003, -0.012), (-0.11, 0.015, -0.03)], 16)
    flex = capsule(cord, 0.0035, material=dark, sides=10, up=(0.0, 0.2, 1.0))
    return Tool(
        merged([body, shield, *slots, nozzle, handle, trigger, plate, seam, feed, flex]),
        (
            plastic(rng, (34, 76, 150)),
            rubber(rng, (38, 38, 42)),
            plastic(rng, (215, 95, 30)),
            brushed(rng, (196, 160, 92), 0.7),
            plastic(rng, (205, 198, 178)),
            striped(rng, (226, 224, 214), (190, 40, 34), period_m=0.03, along=3, share=0.4),
        ),
        np.array([x, 0.0, 0.124]),
        np.array([0.0, 0.0, 1.0]),
        half_depth=0.0135,
        half_width=0.017,
        slide_m=0.005,
        tilt_deg=(-15.0, 12.0),
        spin_deg=(-15.0, 15.0),
    )


def screwdriver(rng: np.random.Generator) -> Tool:
    """Return a flat-bladed screwdriver, 22 cm."""
    grip, cap, shaft = range(3)
    profile = [
        (-0.058, 0.010), (-0.055, 0.0135), (-0.045, 0.0155), (-0.02, 0.0155), (0.01, 0.0150),
        (0.034, 0.0125), (0.042, 0.0105), (0.050, 0.0120), (0.054, 0.0095),
    ]  # fmt: skip
    handle = revolve(profile, material=grip, sides=28)
    butt = revolve([(-0.0615, 0.0095), (-0.0575, 0.0120)], material=cap)
    collar = revolve([(0.052, 0.0075), (0.060, 0.0065)], material=cap)
    rod = revolve([(0.055, 0.0033), (0.100, 0.0033), (0.140, 0.0033)], material=shaft, sides=16)
    blade = loft(
        [(0.136, 0, 0), (0.146, 0, 0), (0.158, 0, 0), (0.164, 0, 0)],
        [(0.0031, 0.0031), (0.0042, 0.0022), (0.0040, 0.0010), (0.0034, 0.0006)],
        superellipse(16, 4.0),
        material=shaft,
    )
    return Tool(
        merged([handle, butt, collar, rod, blade]),
        (
            striped(rng, (196, 34, 30), (28, 28, 30), period_m=0.12, around=6, share=0.35),
            plastic(rng, (30, 30, 32)),
            brushed(rng, mirror=0.9),
        ),
        np.array([0.164, 0.0, 0.0]),
        np.array([1.0, 0.0, 0.0]),
        half_depth=0.0150,
        half_width=0.0150,
        spin_deg=(-180.0, 180.0),
    )


def pliers(rng: np.random.Generator) -> Tool:
    """Return closed combination pliers, 19 cm."""
    steel, grip, joint = range(3)
    parts: list[Mesh] = []
    for side in (-1.0, 1.0):
        handle = spline(
            [(0.054, 0, side * 0.004), (0.036, 0, side * 0.0125), (0.0, 0, side * 0.0165),
             (-0.035, 0, side * 0.0150), (-0.066, 0, side * 0.0185)],
            24,
        )  # fmt: skip
        widths = np.interp(np.linspace(0, 1, 24), [0.0, 0.12, 0.2, 0.9, 1.0],
                           [0.0042, 0.0050, 0.0066, 0.0062, 0.0040])  # fmt: skip
        parts.append(
            loft(handle, np.column_stack([widths, 0.92 * widths]), superellipse(18, 2.4),
                 material=grip, up=(0.0, 1.0, 0.0))
        )  # fmt: skip
        jaw_x = (0.046, 0.060, 0.072, 0.090, 0.110, 0.1225, 0.124)
        outer = (0.0060, 0.0125, 0.0115, 0.0090, 0.0065, 0.0044, 0.0036)
        parts.append(
            loft(
                [(x, 0, 0.5 * side * w + side * 0.0002) for x, w in zip(jaw_x, outer, strict=True)],
                [(t, 0.5 * w) for t, w in zip(
                    (0.0040, 0.0052, 0.0050, 0.0045, 0.0036, 0.0028, 0.0022), outer, strict=True)],
                bevelled(0.35),
                material=steel,
            )
        )  # fmt: skip
    rivet = loft(
        [(0.062, -0.0075, 0), (0.062, -0.0068, 0), (0.062, 0.0068, 0), (0.062, 0.0075, 0)],
        (0.0060, 0.0070, 0.0070, 0.0060), circle(20), material=joint,
    )  # fmt: skip
    face = box((0.1225, 0.0, 0.0), (0.0016, 0.0020, 0.0030), material=steel)
    return Tool(
        merged([*parts, rivet, face]),
        (
            brushed(rng, (112, 114, 118), 0.4),
            plastic(rng, (188, 40, 34), gloss=25.0),
            brushed(rng, (150, 152, 156), 0.6),
        ),
        np.array([0.1241, 0.0, 0.0]),
        np.array([1.0, 0.0, 0.0]),
        half_depth=0.0064,
        half_width=0.0225,
        spin_deg=(-20.0, 20.0),
    )


def hammer(rng: np.random.Generator) -> Tool:
    """Return a cross-peen hammer, 27 cm; the tip is the middle of its face."""
    handle, steel, wedge = range(3)
    shaft = loft(
        [(x, 0, 0) for x in (-0.068, -0.064, -0.04, 0.0, 0.05, 0.10, 0.15, 0.205)],
        [(0.0090, 0.0125), (0.0105, 0.0150), (0.0105, 0.0150), (0.0100, 0.0138), (0.0085, 0.0110),
         (0.0078, 0.0100), (0.0085, 0.0112), (0.0090, 0.0118)],
        superellipse(24, 2.3),
        material=handle,
    )  # fmt: skip
    centre = 0.186
    up = (1.0, 0.0, 0.0)
    z = (-0.020, -0.014, 0.014, 0.022, 0.030, 0.040, 0.0425)
    block = loft(
        [(centre, 0, value) for value in z],
        [(0.0120, 0.0125), (0.0128, 0.0135), (0.0128, 0.0135), (0.0100, 0.0100), (0.0105, 0.0105),
         (0.0122, 0.0122), (0.0108, 0.0108)],
        superellipse(24, 5.0),
        material=steel,
        up=up,
    )  # fmt: skip
    peen = loft(
        [(centre, 0, value) for value in (-0.018, -0.030, -0.046, -0.048)],
        [(0.0118, 0.0125), (0.0115, 0.0085), (0.0112, 0.0022), (0.0105, 0.0010)],
        superellipse(24, 5.0),
        material=steel,
        up=up,
    )
    key = box((0.2045, 0.0, 0.0), (0.0012, 0.0060, 0.0020), material=wedge)
    return Tool(
        merged([shaft, block, peen, key]),
        (
            wood(rng, (196, 150, 92)),
            brushed(rng, (74, 76, 80), 0.3),
            brushed(rng, (150, 150, 150), 0.4),
        ),
        np.array([centre, 0.0, 0.0425]),
        np.array([0.0, 0.0, 1.0]),
        half_depth=0.0102,
        half_width=0.0145,
        tilt_deg=(0.0, 25.0),
        spin_deg=(-60.0, 60.0),
        other_ends=(np.array([centre, 0.0, -0.048]),),
    )
