"""A tool in the hand: how it is held, and where that puts its tip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tooltip_cli.sources.sim.hand import (
    COVER,
    FINGER,
    GRIP_Z,
    JOINT,
    METAL,
    PAD,
    PALM_Y,
    SCREW,
    Grip,
    hand_mesh,
    index_finger,
)
from tooltip_cli.sources.sim.materials import Material, brushed, plastic, rubber
from tooltip_cli.sources.sim.mesh import Floats, Mesh, moved, rotation
from tooltip_cli.sources.sim.params import SimParams
from tooltip_cli.sources.sim.tools import build

FINGER_LENGTH_M = 0.112


@dataclass(frozen=True)
class Grasp:
    """Hand and tool as one rigid body, hand frame, m.

    The first materials are the robot's, in the order of ``hand.py``; the tool's follow.
    """

    hand: Mesh
    tool: Mesh
    materials: tuple[Material, ...]
    tip: Floats  # (3,)
    axis: Floats  # (3,) unit, direction in which the tool ends at its tip
    other_ends: tuple[Floats, ...]


def random_grasp(params: SimParams, rng: np.random.Generator) -> Grasp:
    """Return a secure grasp of the tool: slid, tilted and turned in the hand at random.

    ``grip_offset_m`` and ``tilt_deg`` of the parameters shift and fix the grasp without changing
    anything else that the seed draws.
    """
    robot = _robot_materials(rng)
    if params.tool == "robot_finger":
        return _finger_grasp(params, rng, robot)
    tool = build(params.tool, rng)
    slide = float(rng.uniform(-tool.slide_m, tool.slide_m)) + params.grip_offset_m
    tilt = float(rng.uniform(*tool.tilt_deg))
    spin = float(rng.uniform(*tool.spin_deg))
    lean = float(rng.uniform(-6.0, 6.0))
    tilt = tilt if params.tilt_deg is None else params.tilt_deg
    turn = (
        rotation((0, 0, 1), np.radians(lean))
        @ rotation((0, 1, 0), -np.radians(tilt))
        @ rotation((1, 0, 0), np.radians(spin))
    )
    centre = np.array([0.0, PALM_Y - tool.half_depth, GRIP_Z])
    hand_from_tool = np.eye(4)
    hand_from_tool[:3, :3] = turn
    hand_from_tool[:3, 3] = centre + turn @ (slide, 0.0, 0.0)
    depth, width = _turned(tool.half_depth, tool.half_width, np.radians(spin))
    hand = hand_mesh(Grip(centre, turn[:, 0], depth, width))
    placed = moved(tool.mesh, hand_from_tool)
    placed = Mesh(placed.vertices, placed.faces, placed.uv, placed.material + len(robot))

    def in_hand(point: Floats) -> Floats:
        return hand_from_tool[:3, :3] @ point + hand_from_tool[:3, 3]

    return Grasp(
        hand,
        placed,
        robot + tool.materials,
        in_hand(tool.tip),
        turn @ tool.axis,
        tuple(in_hand(end) for end in tool.other_ends),
    )


def _finger_grasp(
    params: SimParams, rng: np.random.Generator, robot: tuple[Material, ...]
) -> Grasp:
    """Return the pointing hand: the outstretched index finger is the tool."""
    length = FINGER_LENGTH_M + float(rng.uniform(-0.004, 0.004)) + 0.5 * params.grip_offset_m
    tilt = float(rng.uniform(-6.0, 10.0))
    tilt = tilt if params.tilt_deg is None else params.tilt_deg
    # The finger points along the hand; its tilt is measured from there, towards the thumb.
    direction = rotation((0, 1, 0), np.radians(tilt)) @ np.array([0.0, -0.12, 1.0])
    finger, tip = index_finger(direction, length)
    end = tip - finger.vertices.mean(axis=0)
    return Grasp(hand_mesh(None), finger, robot, tip, end / np.linalg.norm(end), ())


def _turned(depth: float, width: float, spin: float) -> tuple[float, float]:
    """Return the half thicknesses of an elliptical handle turned about its axis."""
    c, s = np.cos(spin), np.sin(spin)
    return float(np.hypot(depth * c, width * s)), float(np.hypot(depth * s, width * c))


def _robot_materials(rng: np.random.Generator) -> tuple[Material, ...]:
    made = {
        COVER: plastic(rng, (196, 198, 200), gloss=60.0),
        FINGER: plastic(rng, (84, 86, 92), gloss=30.0),
        JOINT: plastic(rng, (56, 57, 61), gloss=30.0),
        METAL: brushed(rng, (150, 152, 156), 0.6),
        PAD: rubber(rng, (58, 56, 56)),
        SCREW: brushed(rng, (70, 70, 74), 0.4),
    }
    return tuple(made[key] for key in sorted(made))
