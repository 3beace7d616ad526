"""Every link of a robot and how it stands to its parent, through Pinocchio: what ``/tf`` holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.rig.kinematics import build_model

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Link:
    """One link and the one that it hangs on."""

    name: str
    parent: str
    fixed: bool  # whether no joint moves it against its parent


@dataclass(frozen=True)
class KinematicTree:
    """The links of a robot below its root."""

    root: str
    links: tuple[Link, ...]  # parents before children
    joint_names: tuple[str, ...]  # movable joints of one degree of freedom
    _model: Any = field(repr=False)
    _frames: tuple[tuple[int, int], ...] = field(repr=False)  # of each link: parent's, its own

    @classmethod
    def from_urdf(cls, urdf: str, source: str) -> KinematicTree:
        """Build the tree from URDF text.

        Raises:
            TooltipError: not a URDF; ``source`` names it.
        """
        import pinocchio

        model = build_model(pinocchio, urdf, source)
        body, joint = pinocchio.FrameType.BODY, pinocchio.FrameType.JOINT
        links, frames, root = [], [], ""
        for index, frame in enumerate(model.frames):
            if frame.type != body:
                continue
            connection = model.frames[frame.parentFrame]
            parent = model.frames[connection.parentFrame]
            if parent.type != body:
                root = root or frame.name
                continue
            links.append(Link(frame.name, parent.name, connection.type != joint))
            frames.append((connection.parentFrame, index))
        names = tuple(
            name
            for index, name in enumerate(model.names)
            if index and model.joints[index].nv == 1  # the first stands for the world
        )
        return cls(root, tuple(links), names, model, tuple(frames))

    def parent_from_link(self, positions: Mapping[str, float]) -> Array:
        """Return (L, 4, 4) for the links in their order.

        Args:
            positions: of joints by name, rad or m; joints that are not named stand at zero.
        """
        import pinocchio

        q = pinocchio.neutral(self._model)
        for name in self.joint_names:
            value = positions.get(name, 0.0)
            model_joint = self._model.joints[self._model.getJointId(name)]
            column = model_joint.idx_q
            if model_joint.nq == 2:  # continuous joints are stored as cosine and sine
                q[column], q[column + 1] = np.cos(value), np.sin(value)
            else:
                q[column] = value
        data = self._model.createData()
        pinocchio.framesForwardKinematics(self._model, data, q)
        return np.array(
            [data.oMf[parent].actInv(data.oMf[own]).homogeneous for parent, own in self._frames]
        ).reshape(-1, 4, 4)
