"""The ``tooltip`` command: finds sub-commands, and turns expected failures into one line."""

from __future__ import annotations

import importlib
import logging
import os
import sys
from typing import Any

import click

from tooltip_cli import __version__
from tooltip_cli.cli.options import printable
from tooltip_cli.errors import TooltipError

# Name -> one line for `tooltip --help`. Each command lives in the module of its name and is
# imported only when it is asked for, so that `--help` answers at once.
COMMANDS = {
    "record": "Record or import images and joint angles into an MCAP log.",
    "info": "Say what a recording holds, and what is wrong with it.",
    "salvage": "Recover what is intact of a damaged recording.",
    "detect": "Find the tip's pixel in each frame by motion.",
    "estimate": "Find the 3D tip in the hand frame.",
    "label": "Label the tip in the test frames, in the browser.",
    "evaluate": "Measure the estimate against hand labels and write a report.",
    "run": "Take many recordings through every stage, resumable.",
    "calibrate": "Find clock offset and camera pose from recordings of one robot.",
    "compare": "Compare reports, frame by frame.",
    "watch": "Estimate the tip while images arrive.",
    "export": "Write the result for viewers and robots.",
    "demo": "Simulate recordings and take them through every stage.",
}


class LazyGroup(click.Group):
    """A group whose commands are imported on use and whose expected failures are one line."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order of the work."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command's module and return the command."""
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"tooltip_cli.cli.{cmd_name}")
        command: click.Command = getattr(module, cmd_name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; a TooltipError becomes its message and exit code."""
        try:
            return super().invoke(ctx)
        except TooltipError as error:
            click.echo(f"Error: {printable(str(error))}", err=True)
            ctx.exit(error.exit_code)


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="tooltip")
@click.option("-v", "--verbose", is_flag=True, help="Say more about what is done, on stderr.")
def main(verbose: bool) -> None:
    """Find where the end of an unknown tool is, from a camera and joint angles.

    \b
    Example:
      tooltip record sim pliers.mcap --tool pliers
      tooltip detect pliers.mcap
      tooltip estimate pliers.mcap
      tooltip evaluate pliers.mcap
    """
    # OpenCV would print its own lines about damaged images beside ours; read when it is imported
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    # small products only: threads of the linear algebra would spin, and round differently
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # and decode a gigapixel that a file of a kilobyte claims
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**25))
    # ours only: gcsfs logs each failed request, and with it what may be a secret
    handler = logging.StreamHandler(sys.stderr)
    handler.addFilter(logging.Filter("tooltip_cli"))
    logging.basicConfig(
        handlers=[handler],
        level=logging.INFO if verbose else logging.WARNING,
        format="%(levelname)s: %(message)s",
    )


if __name__ == "__main__":
    main()
