"""Labels while they are edited: saved at once, restored after a crash, never overwritten unseen."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.helpers import refusal
from tooltip_cli.errors import TooltipError
from tooltip_cli.labels import book as book_module
from tooltip_cli.labels.book import (
    ConflictError,
    LabelBook,
    Rows,
    TipLabel,
    open_book,
    rows_of,
)
from tooltip_cli.labels.files import read_labels
from tooltip_cli.labels.journal import Journal, open_journal

HEADER = "stamp_ns,u,v,state,labeler\n"
HERE = TipLabel("visible", (1.5, 2.25), "ana")
THERE = TipLabel("visible", (3.0, 4.0), "ben")
HIDDEN = TipLabel("occluded", None, "ana")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.labels.csv"


def journal_of(path: Path) -> Path:
    return path.with_name(path.name + ".journal")


def rows(path: Path) -> Rows:
    return rows_of(read_labels(path))


def crash(path: Path, *changes: tuple[int, TipLabel | None]) -> bytes:
    """Make changes and leave without closing; returns the journal."""
    with open_journal(path) as journal:
        found = rows(path) if path.exists() else {}
        journal.restart({"csv": book_module.rows_text(found)})
        book = LabelBook(path, found, journal, ())
        for stamp, label in changes:
            book.change(stamp, book.entries([stamp])[0].revision, label)
    return journal_of(path).read_bytes()


def test_every_change_is_in_the_file_at_once(path: Path) -> None:
    with open_book(path) as book:
        assert not path.exists()
        book.change(20, 0, HERE)
        assert path.read_text() == HEADER + "20,1.50,2.25,visible,ana\n"
        book.change(10, 0, HIDDEN)
        assert path.read_text() == HEADER + "10,,,occluded,ana\n20,1.50,2.25,visible,ana\n"
        book.change(20, 1, None)
        assert path.read_text() == HEADER + "10,,,occluded,ana\n"
        assert journal_of(path).exists()
    assert sorted(item.name for item in path.parent.iterdir()) == [path.name]


def test_reopening_resumes(path: Path) -> None:
    with open_book(path) as book:
        book.change(20, 0, HERE)
    with open_book(path) as book:
        entry, missing = book.entries([20, 30])
        assert entry.label == HERE
        assert missing.label is None
        assert book.notes == ()


def test_a_change_from_an_old_state_is_refused_and_shown_the_new_one(path: Path) -> None:
    with open_book(path) as book:
        first = book.change(20, 0, HERE)
        with pytest.raises(ConflictError) as caught:
            book.change(20, 0, THERE)
        assert caught.value.entry == first
        assert rows(path)[20] == HERE
        assert book.change(20, first.revision, THERE).label == THERE
        assert book.change(30, 0, THERE).label == THERE  # another frame is no conflict


def test_a_change_that_is_sent_again_is_no_conflict(path: Path) -> None:
    with open_book(path) as book:
        assert book.change(20, 0, HERE) == book.change(20, 0, HERE)


def test_what_another_program_writes_is_taken_over_and_not_overwritten(path: Path) -> None:
    with open_book(path) as book:
        book.change(20, 0, HERE)
        book.change(30, 0, HERE)
        path.write_text(HEADER + "20,3.00,4.00,visible,ben\n30,1.50,2.25,visible,ana\n")
        with pytest.raises(ConflictError) as caught:
            book.change(20, 1, HIDDEN)
        assert caught.value.entry.label == THERE
        book.change(30, 2, HIDDEN)  # untouched by the other program
        assert rows(path) == {20: THERE, 30: HIDDEN}


def test_a_file_that_vanishes_comes_back(path: Path) -> None:
    with open_book(path) as book:
        book.change(20, 0, HERE)
        path.unlink()
        book.change(30, 0, THERE)
    assert rows(path) == {20: HERE, 30: THERE}


def test_a_malformed_file_is_refused_and_left_alone(path: Path) -> None:
    path.write_text("stamp,u\n")
    with pytest.raises(TooltipError, match="expected the header"), open_book(path):
        pass
    assert path.read_text() == "stamp,u\n"
    path.unlink()
    with open_book(path) as book:
        book.change(20, 0, HERE)
        path.write_text("nonsense\n")
        with pytest.raises(TooltipError, match="expected the header"):
            book.change(30, 0, HERE)
        assert path.read_text() == "nonsense\n"


def test_a_crash_between_journal_and_file_loses_nothing(path: Path) -> None:
    crash(path, (20, HERE))
    before = path.read_bytes()
    crash(path, (30, HIDDEN), (40, THERE))
    path.write_bytes(before)
    with open_book(path) as book:
        assert rows(path) == {20: HERE, 30: HIDDEN, 40: THERE}
        (note,) = book.notes
        assert note == f"{path.name}: restored 2 changes from {path.name}.journal"


@pytest.mark.parametrize("left", [None, "", HEADER, HEADER[:10]])
def test_a_file_that_a_crash_cut_short_is_restored(left: str | None, path: Path) -> None:
    crash(path, (20, HERE), (30, HIDDEN))
    path.unlink()
    if left is not None:
        path.write_text(left)
    with open_book(path):
        assert rows(path) == {20: HERE, 30: HIDDEN}


def test_a_crash_after_the_last_change_leaves_nothing_to_do(path: Path) -> None:
    crash(path, (20, HERE), (20, None), (20, HERE))
    with open_book(path) as book:
        assert book.notes == ()
        assert rows(path) == {20: HERE}


@pytest.mark.parametrize("cut", [1, 5, 12, 30])
def test_a_half_written_change_is_left_out(cut: int, path: Path) -> None:
    whole = crash(path, (20, HERE), (30, THERE))
    with open_book(path):
        pass
    path.unlink()
    journal_of(path).write_bytes(whole[:-cut])
    with open_book(path) as book:
        assert rows(path) == {20: HERE}
        assert "half-written" in book.notes[0]


@given(where=st.integers(0, 10_000), bit=st.integers(0, 7))
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_a_flipped_bit_in_the_journal_never_makes_a_label(where: int, bit: int, path: Path) -> None:
    path.unlink(missing_ok=True)
    journal_of(path).unlink(missing_ok=True)
    data = bytearray(crash(path, (20, HERE), (30, THERE)))
    data[where % len(data)] ^= 1 << bit
    path.unlink()
    journal_of(path).write_bytes(data)
    with open_book(path) as book:
        restored = dict(rows(path)) if path.exists() else {}
        assert restored in ({}, {20: HERE})
        assert any("half-written" in note for note in book.notes)


def test_a_journal_does_not_undo_what_another_program_wrote_since(path: Path) -> None:
    crash(path, (20, HERE), (30, THERE))
    path.write_text(HEADER + "20,7.00,8.00,visible,eve\n")
    with open_book(path) as book:
        assert list(rows(path)) == [20]
        assert "changed by another program" in book.notes[0]
        assert book.entries([20])[0].label == TipLabel("visible", (7.0, 8.0), "eve")


def test_only_one_process_edits_a_file(path: Path) -> None:
    code = (
        "import sys\nfrom pathlib import Path\nfrom tooltip_cli.labels.book import open_book\n"
        "with open_book(Path(sys.argv[1])) as book:\n    print('open', flush=True)\n    input()\n"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", code, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[1],
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == "open\n"
    message = "being edited by another 'tooltip label'"
    with pytest.raises(TooltipError, match=message), open_book(path):
        pass
    holder.kill()  # the lock dies with its process
    holder.communicate()
    with open_book(path):
        pass


def test_a_full_disk_changes_nothing(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_book(path) as book:
        book.change(20, 0, HERE)

        def full(target: Path, data: str) -> None:
            raise TooltipError(f"{target}: cannot be written (No space left on device)")

        journal = journal_of(path).read_bytes()
        with monkeypatch.context() as patch:
            patch.setattr(book_module, "write_file", full)
            assert "No space left" in (refusal(lambda: book.change(30, 0, HERE)) or "")
        assert journal_of(path).read_bytes() == journal
        assert book.entries([30])[0].label is None
        book.change(30, 0, THERE)
    assert rows(path) == {20: HERE, 30: THERE}


def test_a_journal_that_cannot_be_written_is_as_before(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_journal(path) as journal:
        journal.append({"csv": HEADER})
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", _fail)
            with pytest.raises(TooltipError, match="cannot be written"):
                journal.append({"stamp_ns": 20, "label": None})
        assert journal.read() == ([{"csv": HEADER}], False)
        assert isinstance(journal, Journal)


def _fail(descriptor: int) -> None:
    raise OSError(5, "Input/output error")


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(TooltipError, match="--out"), open_book(tmp_path / "no" / "a.labels.csv"):
        pass
