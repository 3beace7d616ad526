"""What one would write instead: decode each image, run Canny, and perhaps an optical flow.

    python tests/benchmarks/pipeline/loop.py REC [--flow dis-fast]

It keeps nothing: no file is written, no motion model fitted. `run.py` compares `tooltip detect`
with it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

DIS = {"dis-ultrafast": 0, "dis-fast": 1, "dis-medium": 2}  # OpenCV's presets


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--flow", choices=sorted(DIS))
    options = parser.parse_args()
    cv2.setNumThreads(1)
    library: Any = cv2  # its type stubs lack the flows
    flow = library.DISOpticalFlow_create(DIS[options.flow]) if options.flow else None
    last = None
    with options.recording.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, _, _, message in reader.iter_decoded_messages():
            if schema is None or schema.name != "sensor_msgs/msg/CompressedImage":
                continue
            image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_GRAYSCALE)
            cv2.Canny(image, 50, 150)
            if flow is not None and last is not None:
                flow.calc(last, image, None)
            last = image


if __name__ == "__main__":
    main()
