"""Make the picture of what goes wrong: ``python docs/make_failures.py WORK``.

Simulates the cases below in WORK (minutes; once), estimates each tip, and draws the frame in which
the tip lies farthest from the truth: ring the truth, green cross the tip, orange ones other ends.
"""

from __future__ import annotations

import argparse
import io
import json
from pathlib import Path

import numpy as np
from PIL import Image

from tooltip_cli.log.recording import read_recording
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.report.overlay import GREEN, WHITE, Circle, Shape, cross, overlay_png, whole
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.sources.sim import SimParams
from tooltip_cli.stages.estimate import estimate_from_images
from tooltip_cli.stages.held_out import unlabelled
from tooltip_cli.stages.simulate import reuse_simulation

PICTURE = Path(__file__).parent / "images" / "failures.png"
CASES = {
    "pen": SimParams("pen", tilt_deg=-40.0, background="clutter"),
    "plug": SimParams("electrical_plug", tilt_deg=-40.0, background="clutter"),
    "brush": SimParams("paint_brush", background="clutter"),
}
_ORANGE = "#ff9900"
_PANEL = (400, 300)  # pixels
_GAP = 8
_COLOURS = 128


def main() -> None:
    """Write the picture and say how large it is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path, help="directory for the recordings")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    width, height = _PANEL
    picture = Image.new("RGB", (len(CASES) * (width + _GAP) - _GAP, height), "white")
    for place, (name, params) in enumerate(CASES.items()):
        recording = reuse_simulation(params, options.work / f"{name}.mcap", jobs=2).recording
        with Image.open(io.BytesIO(drawn(recording, options.work))) as panel:
            small = panel.convert("RGB").resize(_PANEL, Image.Resampling.LANCZOS)
        picture.paste(small, (place * (width + _GAP), 0))
    few = picture.quantize(_COLOURS, method=Image.Quantize.MAXCOVERAGE)
    few.save(PICTURE, optimize=True)
    print(f"{PICTURE}: {PICTURE.stat().st_size / 1000:.0f} kB")  # noqa: T201  # for the person who runs it


def drawn(path: Path, work: Path) -> bytes:
    """Estimate the tip of one recording and draw it beside the truth, as PNG."""
    recording = read_recording(path)
    rig = resolve_rig(recording, None)
    views = resolve_views(recording, rig)
    found = estimate_from_images(
        recording,
        rig,
        views,
        EstimatorParams(method="voting"),
        unlabelled(recording, views.camera, None),
        out=work / "estimates",
    ).estimate
    truth = np.array(json.loads(recording.attachments["truth.json"])["tip_in_hand_m"])
    ends = np.array([truth, *(item.position for item in found.candidates)])
    camera = inverse_transform(views.hand_from_camera)
    pixels = np.stack(
        [views.camera.project(ends @ pose[:3, :3].T + pose[:3, 3]) for pose in camera]
    )
    frame = int(np.nanargmax(np.linalg.norm(pixels[:, 0] - pixels[:, 1], axis=1)))
    shapes: list[Shape] = [
        Circle(float(pixels[frame, 0, 0]), float(pixels[frame, 0, 1]), 9.0, WHITE, 2.5)
    ]
    for (u, v), color in zip(pixels[frame, 1:], [GREEN] + len(ends) * [_ORANGE], strict=False):
        shapes += cross(float(u), float(v), 26, color, 3.0)
    image = next(iter(recording.images([frame])))
    return overlay_png(image, whole(image), shapes)


if __name__ == "__main__":
    main()
