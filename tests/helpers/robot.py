"""A two-axis wrist in front of a camera, and its kinematics written out by hand."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.rigfile import Rig, Sphere

Array = npt.NDArray[np.float64]

CAMERA = CameraModel(
    160, 120, 140.0, 141.0, 79.5, 59.5, "plumb_bob", (-0.05, 0.01, 1e-4, -2e-4, 0.0)
)
CAMERA_FRAME = "camera_optical_frame"
HAND_FRAME = "hand"
JOINTS = ("wrist_pitch", "wrist_roll")
WRIST = np.array([0.01, 0.02, 0.42])  # metres, camera frame
FOREARM = np.array([0.0, -0.02, 0.01])  # from the pitch axis to the roll axis
TIP = np.array([0.03, -0.05, -0.12])  # metres, hand frame
SPHERES = (Sphere((0.0, 0.0, 0.0), 0.03),)
LIMIT = '<limit lower="-3" upper="3" effort="1" velocity="1"/>'

URDF = f"""<robot name="wrist">
  <link name="base"/>
  <link name="{CAMERA_FRAME}"/>
  <joint name="camera_mount" type="fixed">
    <parent link="base"/><child link="{CAMERA_FRAME}"/>
  </joint>
  <link name="forearm"/>
  <joint name="wrist_pitch" type="revolute">
    <parent link="base"/><child link="forearm"/>
    <origin xyz="{WRIST[0]} {WRIST[1]} {WRIST[2]}"/><axis xyz="1 0 0"/>{LIMIT}
  </joint>
  <link name="{HAND_FRAME}"/>
  <joint name="wrist_roll" type="revolute">
    <parent link="forearm"/><child link="{HAND_FRAME}"/>
    <origin xyz="{FOREARM[0]} {FOREARM[1]} {FOREARM[2]}"/><axis xyz="0 1 0"/>{LIMIT}
  </joint>
  <link name="finger"/>
  <joint name="grip" type="prismatic">
    <parent link="{HAND_FRAME}"/><child link="finger"/><axis xyz="0 0 1"/>{LIMIT}
  </joint>
</robot>
"""

RIG = Rig(
    hand_frame=HAND_FRAME,
    camera_frame=CAMERA_FRAME,
    camera=CAMERA,
    urdf=URDF,
    spheres=SPHERES,
)


def camera_from_hand(pitch: float, roll: float) -> Array:
    """Return the (4, 4) transform of the robot above, factor by factor."""
    (sp, cp), (sr, cr) = (np.sin(pitch), np.cos(pitch)), (np.sin(roll), np.cos(roll))
    pitched, rolled = np.eye(4), np.eye(4)
    pitched[:3, :3] = [[1, 0, 0], [0, cp, -sp], [0, sp, cp]]
    pitched[:3, 3] = WRIST
    rolled[:3, :3] = [[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]]
    rolled[:3, 3] = FOREARM
    return np.asarray(pitched @ rolled)


def tip_in_camera(pitch: float, roll: float) -> Array:
    """Return the (3,) tip, metres, camera frame."""
    transform = camera_from_hand(pitch, roll)
    return np.asarray(transform[:3, :3] @ TIP + transform[:3, 3])
