"""Which topic of a log plays which role."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.messages import CAMERA_INFO


def choose_topic(
    types: Mapping[str, str],
    role: str,
    datatypes: Sequence[str],
    wanted: str | None,
    source: str,
    *,
    required: bool = False,
    notes: Sequence[str] = (),
) -> str | None:
    """Return the topic for a role: the wanted one, or the only one of its types.

    Args:
        types: type by topic.
        role: also the name of the option that chooses: ``--<role>``.
        source: the log's name, for messages.
        notes: what else to say where a required topic is missing.

    Raises:
        TooltipError: the wanted topic is not there, several could be meant, or none is and one is
            required; the message lists the candidates.
    """
    known = [topic for topic, datatype in types.items() if datatype in datatypes]
    wanted_types = " or ".join(datatypes)
    if wanted is not None:
        if wanted in known:
            return wanted
        found = f"; found: {', '.join(sorted(known))}" if known else ""
        raise TooltipError(f"{source} has no {wanted_types} on topic {wanted}{found}")
    if len(known) > 1:
        raise TooltipError(
            f"{source} has several topics for {role}: {', '.join(sorted(known))}; choose one with "
            f"--{role}"
        )
    if not known and required:
        listing = ", ".join(f"{name} ({kind})" for name, kind in sorted(types.items()))
        raise TooltipError(
            f"{source} has no {role} topic of type {wanted_types}; it holds: "
            f"{listing or 'no messages'}" + "".join(f"; {note}" for note in notes)
        )
    return known[0] if known else None


def choose_info(
    types: Mapping[str, str], image_topic: str, wanted: str | None, source: str
) -> str | None:
    """Return the camera_info topic: wanted, beside the image topic, or the only one.

    Raises:
        TooltipError: see :func:`choose_topic`.
    """
    known = [topic for topic, kind in types.items() if kind == CAMERA_INFO]
    if wanted is None and len(known) > 1:
        for sibling in info_siblings(image_topic):
            if sibling in known:
                return sibling
    return choose_topic(types, "info", (CAMERA_INFO,), wanted, source)


def info_siblings(image_topic: str) -> tuple[str, str]:
    """Return where image_transport puts the camera_info of a raw or a compressed image topic."""
    parents = image_topic.rstrip("/").split("/")
    beside, above = parents[:-1], parents[:-2]
    return "/".join([*beside, "camera_info"]), "/".join([*above, "camera_info"])
