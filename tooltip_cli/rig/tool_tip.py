"""The estimated tip as a link of the robot."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError, one_of
from tooltip_cli.rig.tree import KinematicTree

Array = npt.NDArray[np.float64]

TIP_LINK = "tool_tip"


def urdf_with_tip(urdf: str, hand_frame: str, position: Array, source: str) -> str:
    """Return a URDF with the link ``tool_tip`` on a fixed joint of the hand.

    The rest of the text stays as it is. The tip has the hand's orientation: what is estimated is
    a point.

    Args:
        position: (3,) metres, hand frame.
        source: what to call the URDF in messages.

    Raises:
        TooltipError: not a URDF, without that hand, or with a link of that name already.
    """
    tree = KinematicTree.from_urdf(urdf, source)
    names = {tree.root, *(link.name for link in tree.links)}
    if hand_frame not in names:
        raise TooltipError(f"{source}: " + one_of("hand frame", hand_frame, names))
    if TIP_LINK in names:
        raise TooltipError(
            f"{source}: the robot already has a link '{TIP_LINK}'; give the URDF without it"
        )
    end = urdf.rfind("</robot")
    if end < 0:
        raise TooltipError(f"{source}: the URDF does not end with </robot>")
    xyz = " ".join(f"{value:.6f}" for value in position)
    addition = (
        f'  <link name="{TIP_LINK}"/>\n'
        f'  <joint name="{TIP_LINK}_joint" type="fixed">\n'
        f"    <parent link={quoteattr(hand_frame)}/>\n"
        f'    <child link="{TIP_LINK}"/>\n'
        f'    <origin xyz="{xyz}" rpy="0 0 0"/>\n'
        "  </joint>\n"
    )
    text = urdf[:end] + addition + urdf[end:]
    check = KinematicTree.from_urdf(text, source)
    found = [
        transform[:3, 3]
        for link, transform in zip(check.links, check.parent_from_link({}), strict=True)
        if (link.name, link.parent) == (TIP_LINK, hand_frame)
    ]
    if not (found and np.allclose(found[0], position, atol=1e-6)):  # it ends in a comment, say
        raise TooltipError(f"{source}: the tip cannot be added to this URDF; check its XML")
    return text
