"""A shelf in a bucket of a real S3 server, with connections that are cut."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.bucket import BUCKET, KEY, SECRET, Cutter, Server, environment, serve, use
from tests.helpers.cli import Outcome, tooltip
from tests.helpers.cluster import Cluster
from tests.helpers.logs import wrist_parts, write_log
from tests.helpers.robot import RIG
from tests.helpers.shelves import METHOD, TIMED, contents, make_shelf
from tooltip_cli.errors import TooltipError
from tooltip_cli.rig.rigfile import rig_files
from tooltip_cli.stages.shelf.plan import read_shelf
from tooltip_cli.stages.shelf.scratch import PREFIX, scratch
from tooltip_cli.stages.shelf.store import Remote, place, read, without_secrets, write

pytest.importorskip("s3fs", reason="the extra s3 is not installed")
pytest.importorskip("moto.server", reason="moto's server is not installed")


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serve() as running:
        yield running


@pytest.fixture
def bucket(server: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Server:
    """Return the server, known to the provider's library; scratch folders lie in tmp_path."""
    use(monkeypatch, environment(server.port))
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return server


def run(*arguments: object) -> Outcome:
    """Run a shelf with one process."""
    return tooltip("run", *arguments, *METHOD, "--jobs", 1)


def table(text: str) -> list[dict[str, str]]:
    rows = csv.DictReader(io.StringIO(text))
    return [{key: value for key, value in row.items() if key not in TIMED} for row in rows]


def results(server: Server, prefix: str, folder: Path) -> Path:
    """Copy results from the bucket to a folder."""
    for name, data in server.objects(prefix).items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return folder


def test_a_bucket_gives_what_a_folder_gives(
    bucket: Server, wrist_file: Path, tmp_path: Path
) -> None:
    shelf = make_shelf(tmp_path / "shelf", wrist_file)
    shutil.copy(shelf / "w0.labels.csv", shelf / "w0.labels.other.csv")
    bucket.upload(shelf, "same")
    done = run(f"s3://{BUCKET}/same")
    assert "4 recordings: 3 ok, 0 refused, 1 failed; 0 reused" in done.out, done.err
    run(shelf)
    remote = results(bucket, "same/run", tmp_path / "remote")

    def moved(value: Any) -> Any:
        return json.loads(json.dumps(value).replace(f"s3://{BUCKET}/same", str(shelf)))

    inputs = ("inputs",)  # versions and times of change are not the same thing
    assert moved(contents(remote, inputs)) == contents(shelf / "run", inputs)
    assert len([name for name in contents(remote) if name.endswith(".mcap")]) >= 3
    ours = table((remote / "results.csv").read_text())
    assert moved(ours) == table((shelf / "run" / "results.csv").read_text())
    assert {row["name"]: row["status"] for row in ours} == {
        "cut": "failed",
        "w0": "ok",
        "w2": "ok",
        "sub/w1": "ok",
    }
    assert list((tmp_path / "tmp").iterdir()) == []


def test_what_is_finished_in_a_bucket_is_not_fetched_again(
    bucket: Server, wrist_file: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    bucket.upload(make_shelf(tmp_path / "shelf", wrist_file, 2), "twice")
    shelf = f"s3://{BUCKET}/twice"
    run(shelf)
    before = bucket.objects("twice/run/recordings")
    bucket.client().delete_object(Bucket=BUCKET, Key="twice/run/recordings/sub/w1/w1.tip.json")
    fetched = Counted(bucket.port)
    use(monkeypatch, {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{fetched.port}"})
    done = run(shelf)
    fetched.close()
    assert "1 of 3 recordings are finished already" in done.err
    assert "w0.mcap" not in fetched.seen
    assert "w1.mcap" in fetched.seen
    after = bucket.objects("twice/run/recordings")
    changed = {name for name in after if after[name] != before.get(name)}
    assert {name for name in changed if not name.startswith("cut/")} == {
        "sub/w1/row.json",
        "sub/w1/w1.tip.json",
    }  # the detections are reused
    use(monkeypatch, environment(bucket.port))
    parts = wrist_parts()
    write_log(tmp_path / "new.mcap", {**parts, "images": parts["images"][:-5]})
    bucket.client().upload_file(str(tmp_path / "new.mcap"), BUCKET, "twice/sub/w1.mcap")
    assert "computed" in run(shelf, "--json").out
    row = json.loads(bucket.objects("twice/run/recordings/sub/w1")["row.json"])["row"]
    assert row["frames"] == 35


class Counted(Cutter):
    """Cuts nothing and remembers the names of what is got."""

    def __init__(self, server: int) -> None:
        self.seen: set[str] = set()
        super().__init__(server, lambda request: None, self._note)

    def _note(self, request: bytes) -> None:
        words = request.split(b"\r\n", 1)[0].decode().split()
        if words[0] == "GET" and "?" not in words[1]:
            self.seen.add(words[1].rpartition("/")[2])


def test_workers_of_a_cluster_fetch_for_themselves(
    bucket: Server, wrist_file: Path, tmp_path: Path
) -> None:
    pytest.importorskip("distributed")
    bucket.upload(make_shelf(tmp_path / "shelf", wrist_file, 2), "dask")
    cluster = Cluster(tmp_path)
    try:
        cluster.start(1)
        done = tooltip("run", f"s3://{BUCKET}/dask", *METHOD, "--dask", cluster.address)
    finally:
        cluster.stop()
    assert "3 recordings: 2 ok, 0 refused, 1 failed; 0 reused" in done.out, done.err
    cluster_rows = table(bucket.objects("dask/run")["results.csv"].decode())
    run(f"s3://{BUCKET}/dask", "--force")
    assert table(bucket.objects("dask/run")["results.csv"].decode()) == cluster_rows


def test_a_manifest_names_places_anywhere(bucket: Server, wrist_file: Path, tmp_path: Path) -> None:
    bare = write_log(tmp_path / "bare.mcap", wrist_parts(), rig=None)
    make_shelf(tmp_path / "other", wrist_file, 1)
    client = bucket.client()
    for key, path in (
        ("logs/a.mcap", bare),
        ("seen/a.csv", tmp_path / "other" / "w0.labels.csv"),
    ):
        client.upload_file(str(path), BUCKET, key)
    for name, text in rig_files(RIG).items():
        client.put_object(Bucket=BUCKET, Key=f"rigs/{name}", Body=text.encode())
    text = (
        "recording,rig,labels,operator\n"
        "logs/a.mcap,rigs/rig.yaml,seen/a.csv,ana\n"
        f"{wrist_file},,,bob\n"
        "logs/none.mcap,,,eve\n"
    )
    client.put_object(Bucket=BUCKET, Key="m.csv", Body=text.encode())
    done = run(f"s3://{BUCKET}/m.csv", "--out", tmp_path / "out")
    first, second, third = table((tmp_path / "out" / "results.csv").read_text())
    assert (first["name"], first["status"], first["scored"]) == ("logs/a", "ok", "10"), done.err
    assert first["rig"] == f"s3://{BUCKET}/rigs/rig.yaml"
    assert Path(first["tip_file"]).is_relative_to(tmp_path / "out")
    assert (second["status"], second["recording"]) == ("ok", str(wrist_file))
    assert third["reason"] == f"s3://{BUCKET}/logs/none.mcap: is not there"
    part = (tmp_path / "out/recordings/logs/a/parts/a.json").read_text()
    assert f"s3://{BUCKET}/rigs/rig.yaml" in part


@pytest.mark.parametrize(
    ("pattern", "names"),
    [("*.mcap", ["a", "b"]), ("**/*.mcap", ["a", "b", "sub/c"]), ("s*/c.mcap", ["c"])],
)
def test_a_pattern_in_a_bucket(bucket: Server, pattern: str, names: list[str]) -> None:
    for name in ("a.mcap", "b.mcap", "b.edges.mcap", "sub/c.mcap", "sub/c.txt"):
        bucket.client().put_object(Bucket=BUCKET, Key=f"some/{name}", Body=b"")
    found = read_shelf(f"s3://{BUCKET}/some/{pattern}")
    assert [item.name.removeprefix("sub/" if names == ["c"] else "") for item in found.items] == (
        names
    )
    with pytest.raises(TooltipError, match="the bucket has to be named"):
        read_shelf("s3://la*/a.mcap")


def test_names_are_taken_as_they_are(bucket: Server, wrist_file: Path, tmp_path: Path) -> None:
    odd = "a[1] ä*?.mcap"
    for key in (f"odd/{odd}", "odd2/other.mcap"):
        bucket.client().upload_file(str(wrist_file), BUCKET, key)
    bucket.client().put_object(Bucket=BUCKET, Key="odd/folder/", Body=b"")
    done = run(f"s3://{BUCKET}/odd")
    assert "1 recordings: 1 ok, 0 refused, 0 failed; 0 reused" in done.out, done.err
    (row,) = table(bucket.objects("odd/run")["results.csv"].decode())
    assert row["recording"] == f"s3://{BUCKET}/odd/{odd}"
    assert "1 of 1 recordings are finished already" in run(f"s3://{BUCKET}/odd").err


def test_a_cut_connection_leaves_no_half_object(bucket: Server, monkeypatch: Any) -> None:
    big = Remote(f"s3://{BUCKET}/cut/big")
    write(big, b"a" * 3_000_000)
    always = Cutter(bucket.port, lambda request: 500_000)
    use(monkeypatch, {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{always.port}"})
    with pytest.raises(TooltipError, match=r"cut/big: cannot be written \(.*Error") as raised:
        write(big, b"b" * 3_000_000)
    assert always.cuts
    assert SECRET not in str(raised.value)
    assert KEY not in str(raised.value)
    with pytest.raises(TooltipError, match="cannot be written"):
        write(Remote(f"s3://{BUCKET}/cut/new"), b"b" * 3_000_000)
    always.close()
    assert bucket.objects("cut") == {"big": b"a" * 3_000_000}
    assert bucket.unfinished() == 0


def test_an_upload_in_parts_is_completed_or_aborted(bucket: Server, monkeypatch: Any) -> None:
    def rule(request: bytes) -> int | None:
        return 1_000_000 if b"partNumber=3" in request else None

    cutter = Cutter(bucket.port, rule)
    use(monkeypatch, {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{cutter.port}"})
    with pytest.raises(TooltipError, match="cannot be written"):
        write(Remote(f"s3://{BUCKET}/parts/big"), bytes(130 << 20))
    cutter.close()
    assert cutter.cuts
    assert bucket.objects("parts") == {}
    assert bucket.unfinished() == 0


def test_a_connection_that_is_cut_once_costs_nothing(
    bucket: Server, wrist_file: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    bucket.upload(make_shelf(tmp_path / "shelf", wrist_file, 1), "once")
    cuts: list[bytes] = []

    def rule(request: bytes) -> int | None:
        if b".tip.json" in request and not cuts:
            cuts.append(request)
            return 600
        return None

    cutter = Cutter(bucket.port, rule)
    use(monkeypatch, {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{cutter.port}"})
    done = run(f"s3://{BUCKET}/once")
    cutter.close()
    assert cutter.cuts == 1
    assert "2 recordings: 1 ok, 0 refused, 1 failed" in done.out, done.err


def test_results_that_were_lost_on_the_way_are_made_up_for(
    bucket: Server, wrist_file: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    bucket.upload(make_shelf(tmp_path / "shelf", wrist_file, 2), "lost")

    def rule(request: bytes) -> int | None:
        return 600 if b"w1.tip.json" in request else None

    cutter = Cutter(bucket.port, rule)
    use(monkeypatch, {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{cutter.port}"})
    done = run(f"s3://{BUCKET}/lost")
    cutter.close()
    assert "3 recordings: 1 ok, 0 refused, 2 failed" in done.out
    assert f"s3://{BUCKET}/lost/run/recordings/sub/w1/w1.tip.json: cannot be written" in done.err
    for data in bucket.objects("lost/run").values():
        assert SECRET.encode() not in data
    half = [name for name in bucket.objects("lost/run/recordings/sub/w1") if "tip" in name]
    assert half == []
    use(monkeypatch, {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{bucket.port}"})
    done = run(f"s3://{BUCKET}/lost")
    assert "3 recordings: 2 ok, 0 refused, 1 failed; 1 reused" in done.out, done.err


def test_nothing_is_computed_for_a_bucket_that_takes_nothing(
    bucket: Server, wrist_file: Path, tmp_path: Path
) -> None:
    shelf = make_shelf(tmp_path / "shelf", wrist_file, 1)
    done = run(shelf, "--out", "s3://nowhere/results")
    assert done.code == 1
    assert "s3://nowhere/results" in done.error
    assert not done.out
    done = run("s3://nowhere/shelf")
    assert "s3://nowhere/shelf: is not there" in done.error


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("s3://id:hunter2@lab/x", "carries credentials"),
        ("az://box/x?sig=hunter2", "carries credentials or a query"),
        ("ftp://hunter2/x", "unknown kind of store 'ftp://'"),
        ("s3://", "names no bucket"),
        ("s3://lab/a/../b", "names no bucket"),
    ],
)
def test_an_address_that_is_none_is_refused_without_repeating_secrets(
    text: str, message: str
) -> None:
    with pytest.raises(TooltipError, match=message) as raised:
        place(text)
    assert "hunter2" not in str(raised.value)
    assert place("abfs://box@account.dfs.core.windows.net/x") != Path()
    assert place("some/path") == Path("some/path")


@pytest.mark.parametrize(
    "text",
    [
        "GET https://id:hunter2@host/x failed",
        "https://host/x?X-Amz-Signature=hunter2&a=b: 403",
        "AccountKey=hunter2;EndpointSuffix=x",
        "Authorization: Bearer hunter2",
        "{'aws_secret_access_key': 'hunter2'}",
        "<AWSAccessKeyId>hunter2</AWSAccessKeyId>",
        "x-amz-security-token:hunter2",
        "SharedAccessSignature sv=1&sig=hunter2",
        "the key AKIAhunter2".replace("hunter2", "HUNTER2HUNTER2"),
    ],
)
def test_what_a_provider_says_is_repeated_without_secrets(text: str) -> None:
    said = without_secrets(text)
    assert "hunter2" not in said.lower()
    assert said


def test_a_store_whose_package_is_missing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    import fsspec

    def missing(protocol: str) -> None:
        raise ImportError(protocol)

    monkeypatch.setattr(fsspec, "get_filesystem_class", missing)
    with pytest.raises(TooltipError, match=r"tooltip-cli\[gs\]"):
        read(Remote("gs://lab/x"))


def test_scratch_of_a_killed_process_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    left = tmp_path / f"{PREFIX}left"
    (left / "recording").mkdir(parents=True)
    (left / "recording" / "x.mcap").touch()
    fresh = tmp_path / f"{PREFIX}fresh"
    fresh.mkdir()
    long_ago = time.time() - 3600
    with scratch() as held:
        for folder in (left, held):
            os.utime(folder, (long_ago, long_ago))
        with scratch() as mine:
            assert mine.is_dir()
        assert {path.name for path in tmp_path.iterdir()} == {held.name, fresh.name}
    assert list(tmp_path.iterdir()) == [fresh]
