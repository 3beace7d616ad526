"""A good recording, cut, and with flipped bits: what is whole is recovered, and nothing else.

1. Cut at random offsets: salvage recovers every message of every complete chunk, and nothing that
   was not there; reading the cut file is refused with a line that names salvage.
2. Single bits flipped at random offsets, in files packed with zstd, with lz4 and not at all: none
   is read as good data that differs from the original; each is reported, and salvage of it yields
   nothing that was not there.

    python -m tests.soak.damage REC [--cuts 300] [--flips 1000] [--seed 0]
"""

from __future__ import annotations

import argparse
import json
import random
import tempfile
from collections import Counter
from pathlib import Path

from mcap.writer import CompressionType

from tests.helpers.damage import chunk_ends, content, repacked, salvaged
from tooltip_cli.errors import DamagedLogError, TooltipError


def main() -> None:
    """Print one line of JSON for each kind of damage."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--cuts", type=int, default=300)
    parser.add_argument("--flips", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print(json.dumps(cuts(options.recording, folder, options.cuts, rng)), flush=True)
        for compression in (CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE):
            path = repacked(options.recording, folder / "packed.mcap", compression)
            count = options.flips // 3 + (compression is CompressionType.ZSTD) * (options.flips % 3)
            print(json.dumps(flips(path, folder, count, rng, compression.name)), flush=True)


def cuts(path: Path, folder: Path, count: int, rng: random.Random) -> dict[str, object]:
    """Cut a file and salvage it."""
    data, whole = path.read_bytes(), content(path)
    ends = chunk_ends(path)
    found: Counter[str] = Counter()
    broken, out = folder / "cut.mcap", folder / "out.mcap"
    for offset in sorted(rng.sample(range(len(data)), count)):
        broken.write_bytes(data[:offset])
        found["refused"] += refused(broken)
        complete = sum(messages for end, messages in ends if end <= offset)
        rescued = salvaged(broken, out)
        if rescued is None:
            assert complete == 0, offset
            found["held nothing yet"] += 1
            continue
        assert rescued == whole[: len(rescued)], offset
        assert len(rescued) >= complete, offset
        found["salvaged"] += 1
        found["messages beyond the complete chunks"] += len(rescued) - complete
    return {"damage": "cut", "files": count, "chunks": len(ends), **found}


def flips(
    path: Path, folder: Path, count: int, rng: random.Random, compression: str
) -> dict[str, object]:
    """Flip one bit of a file at a time."""
    data, whole = bytearray(path.read_bytes()), content(path)
    known = Counter(whole)
    found: Counter[str] = Counter()
    broken, out = folder / "flipped.mcap", folder / "out.mcap"
    lost = 0
    for offset in (rng.randrange(len(data)) for _ in range(count)):
        bit = 1 << rng.randrange(8)
        data[offset] ^= bit
        broken.write_bytes(data)
        data[offset] ^= bit
        found["reported"] += refused(broken)
        rescued = salvaged(broken, out)
        if rescued is None:
            found["not salvaged"] += 1
            continue
        found["salvaged"] += 1
        assert not Counter(rescued) - known, offset
        lost += len(whole) - len(rescued)
    share = lost / max(found["salvaged"], 1) / len(whole)
    return {
        "damage": "flip",
        "compression": compression,
        "files": count,
        **found,
        "mean_share_lost": round(share, 4),
    }


def refused(path: Path) -> int:
    """Return whether reading a file is refused in one line that says what to do."""
    try:
        content(path)
    except DamagedLogError as error:
        if "tooltip salvage" in str(error):
            return 1
        raise
    except TooltipError as error:
        if "is not an MCAP file" in str(error):  # its first bytes
            return 1
        raise
    return 0


if __name__ == "__main__":
    main()
