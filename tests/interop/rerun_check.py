"""What the ``rerun`` package makes of our files: its MCAP check, and its conversion.

    python -m tests.interop.rerun_check PATH_TO_RERUN [FILE.mcap ...]

Without files it makes one of each kind that this program writes.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.helpers.interop import one_of_each


def main() -> None:
    """Print a line for each file; exit with 1 where anything is wrong."""
    rerun, *given = sys.argv[1:]
    failed = False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # settings of its own, in which nothing is reported to anybody
        environment = {**os.environ, "HOME": name, "XDG_CONFIG_HOME": name, "NO_COLOR": "1"}

        def run(*arguments: object) -> subprocess.CompletedProcess[str]:
            return subprocess.run(
                [rerun, *map(str, arguments)],
                check=False,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )

        run("analytics", "disable")
        files = list(map(Path, given)) or list(one_of_each(folder).values())
        for path in files:
            out = folder / "out.rrd"
            for arguments in (
                ("mcap", "check", "--full", path),
                ("mcap", "convert", path, "-o", out, "--application-id", "tooltip"),
            ):
                done = run(*arguments)
                if done.returncode or " WARN " in done.stdout or " ERROR " in done.stdout:
                    failed = True
                    print(f"{path.name}: {arguments[1]} complains\n{done.stdout}")
            size = out.stat().st_size if out.exists() else 0
            print(f"{path.name}: checked, {size} bytes when converted")
            failed |= not size
    sys.exit(failed)


if __name__ == "__main__":
    main()
