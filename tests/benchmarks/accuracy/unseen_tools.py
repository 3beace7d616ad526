"""Tools that the product does not have, for ``unseen.py``; see ``sim/tool.py`` for the frame.

The tip is what somebody who labels images would click on: the point of what is pointed, the middle
of the end face or edge of what is blunt, and where several things reach out, the one that reaches
farthest. Each builder says which.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tooltip_cli.sources.sim.materials import bristles, brushed, plastic, rubber, striped, wood
from tooltip_cli.sources.sim.mesh import (
    Floats,
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

_ALONG, _FINGERWARDS = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def table_spoon(rng: np.random.Generator) -> Tool:
    """Return a spoon, 20 cm; the tip is the outermost point of its bowl's rim."""
    turn = np.linspace(0.12, np.pi - 0.12, 15)
    x = 0.100 - 0.030 * np.cos(turn)
    dip = -0.009 * np.sin(turn) ** 2
    bowl = loft(
        np.column_stack([x, dip, 0 * x]),
        np.column_stack([np.full(15, 0.0011), 0.0205 * np.sin(turn)]),
        superellipse(24, 2.4),
        material=0,
        bulge=(0.0, 0.0003),
    )
    handle = loft(
        [(-0.072, 0, 0), (-0.069, 0, 0), (-0.03, 0, 0), (0.02, 0, 0), (0.060, 0, 0), (0.074, 0, 0)],
        [(0.0010, 0.0060), (0.0013, 0.0098), (0.0014, 0.0080), (0.0018, 0.0050), (0.0024, 0.0034),
         (0.0020, 0.0050)],
        superellipse(20, 2.6), material=0,
    )  # fmt: skip
    return Tool(
        merged([handle, bowl]),
        (brushed(rng, (196, 198, 200), 1.0),),
        np.array([x[-1] + 0.0003, dip[-1], 0.0]),
        _ALONG,
        half_depth=0.0018,
        half_width=0.0085,
        spin_deg=(-40.0, 40.0),
    )


def fork(rng: np.random.Generator) -> Tool:
    """Return a fork, 21 cm; the tip is the middle of the line on which its four tines end."""
    handle = loft(
        [(-0.068, 0, 0), (-0.065, 0, 0), (-0.02, 0, 0), (0.05, 0, 0), (0.078, 0, 0), (0.090, 0, 0),
         (0.104, 0.0005, 0)],
        [(0.0010, 0.0060), (0.0013, 0.0098), (0.0015, 0.0070), (0.0022, 0.0034), (0.0020, 0.0050),
         (0.0014, 0.0115), (0.0012, 0.0122)],
        superellipse(20, 3.0), material=0,
    )  # fmt: skip
    tines = [
        loft(
            [(0.101, 0.0003, z), (0.118, 0.002, z), (0.134, 0.002, z), (0.143, 0.0, z)],
            [(0.0011, 0.0015), (0.0010, 0.0014), (0.0009, 0.0012), (0.0005, 0.0006)],
            superellipse(12, 3.0),
            material=0,
        )
        for z in (-0.0105, -0.0035, 0.0035, 0.0105)
    ]
    return Tool(
        merged([handle, *tines]),
        (brushed(rng, (188, 190, 194), 0.8),),
        np.array([0.143, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0016,
        half_width=0.0080,
        spin_deg=(-40.0, 40.0),
    )


def kitchen_knife(rng: np.random.Generator) -> Tool:
    """Return a chef's knife, 26 cm; the tip is its point, off the handle's axis."""
    handle = loft(
        [(x, 0, 0) for x in (-0.066, -0.062, -0.03, 0.0, 0.04, 0.056, 0.060)],
        [(0.0060, 0.0100), (0.0078, 0.0140), (0.0075, 0.0120), (0.0080, 0.0130), (0.0078, 0.0115),
         (0.0070, 0.0125), (0.0055, 0.0110)],
        superellipse(24, 3.0), material=0,
    )  # fmt: skip
    x = np.array([0.058, 0.066, 0.072, 0.100, 0.130, 0.155, 0.175, 0.188, 0.194])
    spine = np.array([0.011, 0.012, 0.012, 0.012, 0.0115, 0.0105, 0.009, 0.0075, 0.0062])
    edge = np.array([-0.009, -0.012, -0.027, -0.026, -0.023, -0.017, -0.009, -0.001, 0.0050])
    blade = loft(
        np.column_stack([x, 0 * x, 0.5 * (spine + edge)]),
        np.column_stack([np.linspace(0.0011, 0.0005, len(x)), 0.5 * (spine - edge)]),
        bevelled(0.5),
        material=1,
    )
    rivets = [
        loft([(at, -0.0084, 0), (at, 0.0084, 0)], (0.0032, 0.0032), circle(14), material=2)
        for at in (-0.045, 0.045)
    ]
    return Tool(
        merged([handle, blade, *rivets]),
        (
            plastic(rng, (30, 28, 28), gloss=30.0),
            brushed(rng, (184, 188, 192), 0.8),
            brushed(rng, (190, 190, 186), 0.7),
        ),
        np.array([0.194, 0.0, 0.0056]),
        _ALONG,
        half_depth=0.0078,
        half_width=0.0130,
        tilt_deg=(0.0, 25.0),
        spin_deg=(-30.0, 30.0),
    )


def spatula(rng: np.random.Generator) -> Tool:
    """Return a turner of grey nylon, as grey as the fingers; the tip is the middle of its edge."""
    handle = loft(
        [(x, 0, 0) for x in (-0.090, -0.086, -0.03, 0.03, 0.066, 0.072)],
        [(0.0050, 0.0080), (0.0065, 0.0110), (0.0070, 0.0105), (0.0070, 0.0100), (0.0060, 0.0080),
         (0.0045, 0.0060)],
        superellipse(22, 2.5), material=0,
    )  # fmt: skip
    neck = spline([(0.070, 0, 0), (0.095, -0.002, 0), (0.115, -0.010, 0), (0.128, -0.013, 0)], 10)
    shank = loft(neck, np.full((10, 2), (0.0042, 0.0055)), circle(16), material=0)
    x = np.array([0.122, 0.128, 0.138, 0.150, 0.185, 0.203, 0.206])
    blade = loft(
        np.column_stack([x, -0.011 - 0.12 * (x - 0.122), 0 * x]),
        [(0.0030, 0.0080), (0.0026, 0.0200), (0.0020, 0.0310), (0.0016, 0.0350), (0.0012, 0.0375),
         (0.0009, 0.0375), (0.0006, 0.0360)],
        superellipse(28, 8.0), material=0,
    )  # fmt: skip
    return Tool(
        merged([handle, shank, blade]),
        (plastic(rng, (78, 80, 86), gloss=30.0),),
        np.array([0.206, -0.011 - 0.12 * 0.084, 0.0]),
        _ALONG,
        half_depth=0.0070,
        half_width=0.0105,
        tilt_deg=(0.0, 25.0),
        spin_deg=(-40.0, 40.0),
    )  # fmt: skip


def adjustable_wrench(rng: np.random.Generator) -> Tool:
    """Return a wrench opened by 11 mm; the tip is the end of its fixed jaw, the longer one."""
    handle = loft(
        [(x, 0, 0) for x in (-0.078, -0.074, -0.03, 0.03, 0.068, 0.078)],
        [(0.0030, 0.0080), (0.0040, 0.0105), (0.0038, 0.0095), (0.0040, 0.0085), (0.0050, 0.0110),
         (0.0058, 0.0180)],
        superellipse(22, 4.0), material=0,
    )  # fmt: skip
    head = box((0.0905, 0, 0.001), (0.0150, 0.0062, 0.0215), material=0, bevel=0.3)
    fixed = loft(
        [(0.095, 0, 0.0150), (0.110, 0, 0.0145), (0.124, 0, 0.0125), (0.1285, 0, 0.0115)],
        [(0.0060, 0.0075), (0.0056, 0.0070), (0.0050, 0.0045), (0.0042, 0.0030)],
        bevelled(0.3), material=0,
    )  # fmt: skip
    moving = loft(
        [(0.095, 0, -0.0130), (0.110, 0, -0.0125), (0.119, 0, -0.0095), (0.1225, 0, -0.0080)],
        [(0.0052, 0.0075), (0.0050, 0.0070), (0.0046, 0.0045), (0.0040, 0.0030)],
        bevelled(0.3), material=1,
    )  # fmt: skip
    worm = loft(
        [(0.088, 0, -0.012), (0.088, 0, -0.002)], (0.0075, 0.0075), circle(18), material=2,
        up=(1.0, 0.0, 0.0),
    )  # fmt: skip
    return Tool(
        merged([handle, head, fixed, moving, worm]),
        (
            brushed(rng, (136, 140, 146), 0.6),
            brushed(rng, (112, 114, 120), 0.5),
            brushed(rng, (70, 70, 74), 0.4),
        ),
        np.array([0.1285, 0.0, 0.0115]),
        _ALONG,
        half_depth=0.0042,
        half_width=0.0095,
        spin_deg=(-40.0, 40.0),
    )


def flashlight(rng: np.random.Generator) -> Tool:
    """Return a flashlight, 18 cm, 5 cm wide; the tip is the middle of its lens."""
    tube = [(-0.078, 0.0125), (-0.075, 0.0150), (-0.030, 0.0155), (0.048, 0.0155), (0.060, 0.0165)]
    head = [(0.059, 0.0170), (0.072, 0.0235), (0.096, 0.0250), (0.102, 0.0250), (0.103, 0.0238)]
    lens = [(0.0995, 0.0225), (0.1034, 0.0225)]
    ring = revolve([(0.094, 0.0254), (0.098, 0.0254)], material=2, sides=32)
    button = box((0.066, -0.019, 0.0), (0.006, 0.004, 0.004), material=2, bevel=0.4)
    return Tool(
        merged(
            [
                revolve(tube, material=1, sides=28),
                revolve(head, material=0, sides=32),
                revolve(lens, material=3, sides=32),
                ring,
                button,
            ]
        ),
        (
            plastic(rng, (34, 34, 36), gloss=60.0),
            striped(rng, (34, 34, 36), (58, 58, 62), period_m=0.02, along=4, share=0.5),
            plastic(rng, (210, 170, 30)),
            brushed(rng, (200, 204, 206), 0.8),
        ),
        np.array([0.1034, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0155,
        half_width=0.0155,
        spin_deg=(-180.0, 180.0),
    )


def marker(rng: np.random.Generator) -> Tool:
    """Return a thick marker that stands out of the hand by 4 cm; the tip is that of its felt."""
    barrel = [(-0.052, 0.0080), (-0.050, 0.0090), (0.052, 0.0090), (0.060, 0.0088)]
    front = [(0.059, 0.0086), (0.066, 0.0080), (0.076, 0.0058), (0.086, 0.0050), (0.088, 0.0042)]
    felt = [(0.086, 0.0026), (0.092, 0.0026), (0.0955, 0.0018)]
    return Tool(
        merged(
            [
                revolve(barrel, material=0, sides=24),
                revolve(front, material=1, sides=24),
                revolve(felt, material=2, sides=16, tip=0.0006),
                revolve([(0.050, 0.0093), (0.055, 0.0093)], material=2, sides=24),
            ]
        ),
        (
            plastic(rng, (222, 220, 214), gloss=40.0),
            plastic(rng, (40, 40, 42), gloss=40.0),
            rubber(rng, (20, 70, 40)),
        ),
        np.array([0.0961, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0090,
        half_width=0.0090,
        slide_m=0.004,
        spin_deg=(-180.0, 180.0),
    )


def rod(rng: np.random.Generator) -> Tool:
    """Return a wooden rod, 35 cm long and 7 mm thick; the tip is the middle of its flat end."""
    return Tool(
        revolve([(-0.085, 0.0035), (0.0, 0.0035), (0.13, 0.0035), (0.265, 0.0035)], material=0),
        (wood(rng, (214, 184, 136)),),
        np.array([0.265, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0035,
        half_width=0.0035,
        slide_m=0.010,
        tilt_deg=(0.0, 28.0),
        spin_deg=(-180.0, 180.0),
    )


def hex_key(rng: np.random.Generator) -> Tool:
    """Return an L-shaped key held by its long arm; the tip is the end face of its short one."""
    turn = np.linspace(0.0, 0.5 * np.pi, 7)
    bend = np.column_stack([0.105 + 0.010 * np.sin(turn), 0 * turn, 0.010 * (1 - np.cos(turn))])
    path = np.vstack([[(-0.070, 0, 0), (0.0, 0, 0), (0.06, 0, 0)], bend, [(0.115, 0, 0.036)]])
    return Tool(
        loft(path, np.full(len(path), 0.0034), circle(6), material=0, up=(0.0, 1.0, 0.0)),
        (brushed(rng, (58, 58, 62), 0.3),),
        np.array([0.115, 0.0, 0.036]),
        _FINGERWARDS,
        half_depth=0.0032,
        half_width=0.0032,
        tilt_deg=(-10.0, 25.0),
        spin_deg=(-60.0, 60.0),
    )


def mallet(rng: np.random.Generator) -> Tool:
    """Return a percussion mallet; the tip is the point of its ball that is farthest along it."""
    turn = np.linspace(0.15, np.pi, 14)[:-1]
    ball = np.column_stack([0.172 - 0.020 * np.cos(turn), 0.020 * np.sin(turn)])
    end = 0.020 * (1 + np.cos(turn[-1]))  # what the last ring leaves of the sphere
    stick = [(-0.075, 0.0045), (0.0, 0.0045), (0.09, 0.0042), (0.158, 0.0040)]
    return Tool(
        merged(
            [
                revolve(stick, material=0),
                revolve(ball, material=1, sides=28, tip=float(end)),
            ]
        ),
        (wood(rng, (120, 76, 44), gloss=50.0), rubber(rng, (206, 202, 190))),
        np.array([0.192, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0045,
        half_width=0.0045,
        tilt_deg=(0.0, 28.0),
        spin_deg=(-180.0, 180.0),
    )  # fmt: skip


def toothbrush(rng: np.random.Generator) -> Tool:
    """Return a toothbrush, 18 cm; the tip is the end of its head, not of its bristles."""
    body = loft(
        [(x, 0, 0) for x in (-0.068, -0.065, -0.02, 0.03, 0.060, 0.085, 0.098, 0.106, 0.122, 0.126,
                             0.128)],
        [(0.0030, 0.0040), (0.0042, 0.0058), (0.0050, 0.0066), (0.0052, 0.0070), (0.0038, 0.0050),
         (0.0026, 0.0032), (0.0024, 0.0042), (0.0024, 0.0060), (0.0024, 0.0058), (0.0022, 0.0040),
         (0.0018, 0.0022)],
        superellipse(20, 2.4), material=0,
    )  # fmt: skip
    tufts = [
        loft([(x, -0.0018, z), (x, -0.0125, z)], (0.0017, 0.0019), circle(10), material=1)
        for x in (0.1035, 0.1085, 0.1135, 0.1185)
        for z in (-0.0033, 0.0033)
    ]
    grip = box((0.045, -0.0052, 0.0), (0.018, 0.0014, 0.0030), material=2, bevel=0.4)
    return Tool(
        merged([body, *tufts, grip]),
        (
            plastic(rng, (64, 158, 176), gloss=60.0),
            bristles(rng, (226, 228, 230)),
            rubber(rng, (236, 236, 230)),
        ),
        np.array([0.128, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0050,
        half_width=0.0066,
        slide_m=0.006,
        spin_deg=(-90.0, 90.0),
    )


def hook(rng: np.random.Generator) -> Tool:
    """Return a pick whose end is bent by 115 degrees; the tip is its point."""
    turn = np.radians(np.linspace(0.0, 115.0, 11))
    bend = np.column_stack([0.130 + 0.016 * np.sin(turn), 0 * turn, 0.016 * (1 - np.cos(turn))])
    last = np.array([np.cos(turn[-1]), 0.0, np.sin(turn[-1])])
    path = np.vstack([[(0.052, 0, 0), (0.09, 0, 0)], bend, bend[-1] + 0.008 * last])
    path = np.vstack([path, path[-1] + 0.010 * last])
    widths = np.concatenate([np.full(len(path) - 2, 0.0026), [0.0022, 0.0005]])
    handle = [(-0.056, 0.0085), (-0.053, 0.0110), (0.0, 0.0100), (0.045, 0.0115), (0.055, 0.0075)]
    return Tool(
        merged(
            [
                revolve(handle, material=0, sides=24),
                loft(path, widths, circle(14), material=1, up=(0.0, 1.0, 0.0)),
            ]
        ),
        (wood(rng, (150, 60, 40), gloss=60.0), brushed(rng, (170, 172, 176), 0.7)),
        path[-1],
        last,
        half_depth=0.0105,
        half_width=0.0105,
        tilt_deg=(-10.0, 25.0),
        spin_deg=(-60.0, 60.0),
    )


def paint_roller(rng: np.random.Generator) -> Tool:
    """Return a small roller, 9 cm wide; the tip is the middle of the roller's far side."""
    handle = loft(
        [(x, 0, 0) for x in (-0.060, -0.056, 0.0, 0.05, 0.058)],
        [(0.0090, 0.0100), (0.0115, 0.0130), (0.0110, 0.0120), (0.0105, 0.0120), (0.0070, 0.0080)],
        superellipse(22, 2.6), material=0,
    )  # fmt: skip
    frame = spline(
        [(0.050, 0, 0), (0.072, 0, 0), (0.090, 0, 0.020), (0.104, 0, 0.050), (0.118, 0, 0.055),
         (0.140, 0, 0.055), (0.150, 0, 0.048)],
        40,
    )  # fmt: skip
    sleeve = loft(
        [(0.150, 0, z) for z in (-0.0450, -0.0440, 0.0, 0.0440, 0.0450)],
        (0.0155, 0.0170, 0.0170, 0.0170, 0.0155), circle(28), material=2, up=(1.0, 0.0, 0.0),
    )  # fmt: skip
    return Tool(
        merged([handle, capsule(frame, 0.0030, material=1, up=(0.0, 1.0, 0.0)), sleeve]),
        (
            plastic(rng, (24, 120, 70), gloss=30.0),
            brushed(rng, (176, 178, 182), 0.7),
            bristles(rng, (224, 218, 196)),
        ),
        np.array([0.167, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0110,
        half_width=0.0120,
        tilt_deg=(0.0, 25.0),
        spin_deg=(-30.0, 30.0),
    )


def whisk(rng: np.random.Generator) -> Tool:
    """Return a whisk of four wires of 2.2 mm; the tip is where they cross, farthest out."""
    handle = [(-0.060, 0.0060), (-0.057, 0.0085), (0.0, 0.0090), (0.055, 0.0080), (0.062, 0.0070)]
    loop = np.array([(0.058, 0.004), (0.085, 0.011), (0.120, 0.0225), (0.148, 0.0245),
                     (0.168, 0.0160), (0.175, 0.0)])  # fmt: skip
    both = np.vstack([loop, loop[-2::-1] * (1.0, -1.0)])
    wires: list[Mesh] = []
    for angle in np.radians((0.0, 45.0, 90.0, 135.0)):
        outward = np.array([0.0, np.cos(angle), np.sin(angle)])
        normal: Floats = np.array([0.0, -np.sin(angle), np.cos(angle)])
        path = both[:, :1] * _ALONG + both[:, 1:] * outward
        wires.append(capsule(spline(path, 60), 0.0011, material=1, sides=8, up=normal))
    return Tool(
        merged([revolve(handle, material=0, sides=24), *wires]),
        (plastic(rng, (30, 30, 32)), brushed(rng, (186, 188, 192), 0.8)),
        np.array([0.1761, 0.0, 0.0]),
        _ALONG,
        half_depth=0.0090,
        half_width=0.0090,
        tilt_deg=(0.0, 28.0),
        spin_deg=(-180.0, 180.0),
    )


def mug(rng: np.random.Generator) -> Tool:
    """Return a full mug held by its handle; the tip is the middle of its mouth.

    Its bottom is as far away, and so is the side that faces away from the hand: it has no tip.
    """
    middle, up = 0.068, (0.0, 0.0, 1.0)
    body = loft(
        [(x, 0, middle) for x in (-0.047, -0.044, 0.0, 0.046, 0.048)],
        (0.0375, 0.0400, 0.0400, 0.0400, 0.0385), circle(36), material=0, up=up,
    )  # fmt: skip
    drink = loft(
        [(0.044, 0, middle), (0.0485, 0, middle)], (0.0360, 0.0360), circle(36), material=1, up=up
    )
    loop = spline(
        [(-0.034, 0, 0.034), (-0.036, 0, 0.012), (-0.026, 0, 0.0), (0.0, 0, -0.001),
         (0.026, 0, 0.0), (0.036, 0, 0.012), (0.034, 0, 0.034)],
        30,
    )  # fmt: skip
    return Tool(
        merged([body, drink, capsule(loop, 0.0055, material=0, up=(0.0, 1.0, 0.0))]),
        (plastic(rng, (176, 44, 40), gloss=90.0, specular=0.06), plastic(rng, (46, 26, 14))),
        np.array([0.0485, 0.0, middle]),
        _ALONG,
        half_depth=0.0055,
        half_width=0.0055,
        slide_m=0.003,
        tilt_deg=(-10.0, 15.0),
        spin_deg=(-12.0, 12.0),
        other_ends=(np.array([-0.047, 0.0, middle]),),
    )


UNSEEN: dict[str, Callable[[np.random.Generator], Tool]] = {
    "table_spoon": table_spoon,
    "fork": fork,
    "kitchen_knife": kitchen_knife,
    "spatula": spatula,
    "adjustable_wrench": adjustable_wrench,
    "flashlight": flashlight,
    "marker": marker,
    "rod": rod,
    "hex_key": hex_key,
    "mallet": mallet,
    "toothbrush": toothbrush,
    "hook": hook,
    "paint_roller": paint_roller,
    "whisk": whisk,
    "mug": mug,
}
