"""``tooltip salvage``: recover a recording from a truncated or damaged file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tooltip_cli.cli.options import PATH, json_option, plural, print_json, say, utc

if TYPE_CHECKING:
    from tooltip_cli.log.salvage import Loss, Salvaged, TopicCount


@click.command(short_help="Recover what is intact of a damaged recording.")
@click.argument("broken", type=PATH, metavar="BROKEN")
@click.argument("out", type=PATH, metavar="OUT.mcap")
@click.option(
    "--unverified",
    is_flag=True,
    help="Of a damaged file, also take what carries no checksum and may be damaged.",
)
@click.option("--force", is_flag=True, help="Replace OUT.mcap if it exists.")
@json_option
def salvage(broken: Path, out: Path, unverified: bool, force: bool, as_json: bool) -> None:
    """Recover what is intact of a truncated or damaged recording.

    BROKEN may be any MCAP file, such as the OUT.mcap.unfinished that a crash has left. Every
    message whose checksum holds is recovered; so are the whole messages of a last chunk that is
    cut off. OUT.mcap is read back with all checks before it gets its name. BROKEN stays as it is.

    \b
    Examples:
      tooltip salvage pliers.mcap.unfinished pliers.mcap
      tooltip salvage damaged.mcap rescued.mcap --json
    """
    from tooltip_cli.log.salvage import salvage as recover
    from tooltip_cli.stages.artifacts import plain

    result = recover(broken, out, overwrite=force, unverified=unverified)
    if as_json:
        print_json({"recording": str(out), **plain(result)})
        return
    say(f"{broken}: {_STATES[result.state]}")
    for note in result.notes:
        say(f"{broken}: {note}")
    for topic, count in sorted(result.topics.items()):
        say(f"{out}: {_topic(topic, count)}")
    for loss in result.losses:
        say(f"{broken}: lost {_loss(loss)}")
    _advise(broken, result)
    click.echo(out)


_STATES = {
    "whole": "nothing is wrong with it; all of it was copied",
    "truncated": "it was cut off",
    "damaged": "it is damaged",
}


def _topic(topic: str, count: TopicCount) -> str:
    text = f"{count.recovered} {topic}"
    if count.first_ns is not None and count.last_ns is not None:
        text += f", {(count.last_ns - count.first_ns) / 1e9:.1f} s"
    if count.lost:
        text += f", {count.lost} lost"
    if count.left_out:
        text += f", {count.left_out} left out: no checksum tells whether they are damaged"
    return text


def _loss(loss: Loss) -> str:
    text = f"{plural(loss.length, 'byte')} at byte {loss.offset} ({loss.reason})"
    if loss.after_ns is not None and loss.before_ns is not None:
        text += f", between {utc(loss.after_ns)} and {utc(loss.before_ns)}"
    elif loss.after_ns is not None:
        text += f", everything after {utc(loss.after_ns)}"
    elif loss.before_ns is not None:
        text += f", everything before {utc(loss.before_ns)}"
    if loss.messages:
        text += ": " + ", ".join(f"{n} {topic}" for topic, n in sorted(loss.messages.items()))
    return text


def _advise(broken: Path, result: Salvaged) -> None:
    if any(count.left_out for count in result.topics.values()):
        say(f"{broken}: --unverified takes what was left out, too")
