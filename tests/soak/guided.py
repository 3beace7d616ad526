"""The readers of logs under a fuzzer that follows the code's branches (``pip install atheris``).

It pays where a change must pass one check to reach the next: the records of a container. Texts are
left to tests/soak/fuzz.py, for their parsers are not Python.

    python -m tests.soak.guided NAME [-max_total_time=300]
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["tooltip_cli.log", "tooltip_cli.sources"]):
    from tests.helpers.fuzz import attempt, targets


def main() -> None:
    """Feed one reader until the time is over; an uncaught exception ends it with its input."""
    name, *options = sys.argv[1:]
    with tempfile.TemporaryDirectory() as place:
        folder, corpus = Path(place), Path(place) / "corpus"
        target = targets(folder)[name]
        corpus.mkdir()
        for number, seed in enumerate(target.seeds):
            (corpus / str(number)).write_bytes(seed)

        def one(data: bytes) -> None:
            attempt(target, data, folder)

        limits = ["-rss_limit_mb=512", "-timeout=5", "-max_len=65536"]
        atheris.Setup([sys.argv[0], *limits, *options, str(corpus)], one)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
