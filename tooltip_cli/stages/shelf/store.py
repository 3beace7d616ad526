"""Object stores: what a shelf needs of a bucket, through fsspec.

Credentials are the providers' own business: fsspec's implementations look for them where the
provider's tools do, and nothing here takes, passes on, or repeats any.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from tooltip_cli.errors import MissingExtraError, TooltipError, one_of
from tooltip_cli.stages.artifacts import write_whole

EXTRAS = {
    "s3": ("s3", "s3fs"),
    "gs": ("gs", "gcsfs"),
    "gcs": ("gs", "gcsfs"),
    "az": ("az", "adlfs"),
    "abfs": ("az", "adlfs"),
    "abfss": ("az", "adlfs"),
}
"""Protocol -> the extra that it needs and the module behind it."""
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://(.*)", re.DOTALL)
_VERSION_KEYS = ("ETag", "etag", "generation", "md5Hash", "LastModified", "last_modified")
_AT_ONCE = 32  # requests for small objects side by side
_BATCH = 1024  # of them held at once
_SECRETS = (
    (re.compile(r"(?<=://)[^/\s@]*:[^/\s@]*@"), "***@"),
    (re.compile(r"\?[^\s\"'<>)]+"), "?***"),
    (
        re.compile(
            r"(?i)([\w-]*(?:(?:access|account|secret|shared|api)[-_ ]?key(?:[-_ ]?id)?"
            r"|token|signature|password|credential|authorization|\bsig)s?['\"]?\s*[=:>]\s*['\"]?)"
            r"(?:Bearer\s+|Basic\s+)?[^\s\"'<>,;&]+"
        ),
        r"\1***",
    ),
    (re.compile(r"\b(?:AKIA|ASIA)[A-Z0-9]{12,}\b"), "***"),
)


@dataclass(frozen=True, order=True)
class Remote:
    """An object or a folder of a bucket; has what a shelf uses of :class:`pathlib.Path`."""

    url: str  # such as s3://bucket/folder/name, without a slash at the end

    def __str__(self) -> str:
        return self.url

    def __truediv__(self, below: str | Path) -> Remote:
        return Remote(f"{self.url}/{below}")

    @property
    def key(self) -> str:
        """What follows the protocol."""
        return self.url.partition("://")[2]

    @property
    def name(self) -> str:
        """The last part."""
        return self.key.rpartition("/")[2]

    @property
    def stem(self) -> str:
        """The last part without its suffix."""
        return Path(self.name).stem

    @property
    def suffix(self) -> str:
        """The suffix of the last part, with its dot."""
        return Path(self.name).suffix

    @property
    def parent(self) -> Remote:
        """The folder that it lies in; a bucket's own is the bucket."""
        return Remote(self.url.rpartition("/")[0]) if "/" in self.key else self

    def with_name(self, name: str) -> Remote:
        """Return what lies beside it."""
        return self.parent / name

    def absolute(self) -> Remote:
        """Return itself."""
        return self


Place = Path | Remote


@dataclass(frozen=True)
class Seen:
    """An object as a listing has it."""

    size: int  # bytes
    version: str  # another one whenever the content is another


def place(text: str) -> Place:
    """Return a path, or the object that a URL names.

    Raises:
        TooltipError: a URL of no store that is known here, without a bucket, or with credentials
            in it, which would end up in every table that names the place.
    """
    match = _URL.fullmatch(text)
    if match is None:
        return Path(text)
    protocol, key = match[1].lower(), match[2].rstrip("/")
    if protocol not in EXTRAS:
        raise TooltipError(one_of("kind of store", f"{protocol}://", EXTRAS))
    account, at, _ = key.partition("/")[0].rpartition("@")
    if (at and ":" in account) or re.search(r"\?.*=", key):
        raise TooltipError(
            f"a {protocol}:// address carries credentials or a query; leave them to the provider's "
            "own settings and write the address alone (docs/scale.md)"
        )
    if not key or ".." in key.split("/"):
        raise TooltipError(f"{text}: names no bucket, such as {protocol}://bucket/folder")
    return Remote(f"{protocol}://{key}")


def without_secrets(text: str) -> str:
    """Return what a provider's library said without what looks like credentials.

    Queries of URLs go as a whole: they carry signatures.
    """
    for pattern, instead in _SECRETS:
        text = pattern.sub(instead, text)
    return " ".join(text.split())[:400]


@contextmanager
def store_errors(where: Remote, verb: str) -> Iterator[None]:
    """Turn whatever a provider's library raises into one line without credentials."""
    try:
        yield
    except (TooltipError, MemoryError):
        raise
    except FileNotFoundError:
        raise TooltipError(f"{where}: is not there") from None
    except Exception as error:  # each provider has its own kinds; a chained one would be printed
        what = f"{type(error).__name__}: {without_secrets(str(error))}"
        raise TooltipError(
            f"{where}: cannot be {verb} ({what}); check the address, the network, and that the "
            "provider's own tools have credentials here (docs/scale.md)"
        ) from None


def _open(where: Remote) -> tuple[Any, str]:
    """Return the file system of a place, and the place as that calls it."""
    protocol = where.url.partition("://")[0]
    extra, module = EXTRAS[protocol]
    try:
        import fsspec.core

        fsspec.get_filesystem_class(protocol)
    except ImportError:
        raise MissingExtraError(f"{protocol}://", extra, module) from None
    files, path = fsspec.core.url_to_fs(where.url)
    return files, path


def read(where: Remote) -> bytes:
    """Return a small object.

    Raises:
        TooltipError: it is not there or cannot be read.
    """
    with store_errors(where, "read"):
        files, path = _open(where)
        return bytes(files.cat_file(path))


def opened(where: Place) -> BinaryIO:
    """Return a file, or the content of an object, to read from.

    Raises:
        OSError, TooltipError: it cannot be read.
    """
    return where.open("rb") if isinstance(where, Path) else io.BytesIO(read(where))


def read_some(places: Iterable[Remote]) -> Iterator[tuple[Remote, bytes]]:
    """Yield those small objects that are there, in order; many are asked for side by side.

    Raises:
        TooltipError: the store does not answer.
    """
    wanted = list(places)
    # fsspec's own way to ask for many takes [ and * in names for patterns
    with ThreadPoolExecutor(_AT_ONCE) as threads:
        for start in range(0, len(wanted), _BATCH):
            some = wanted[start : start + _BATCH]
            for where, data in zip(some, threads.map(_read_if_there, some), strict=True):
                if data is not None:
                    yield where, data


def _read_if_there(where: Remote) -> bytes | None:
    with store_errors(where, "read"):
        files, path = _open(where)
        try:
            return bytes(files.cat_file(path))
        except FileNotFoundError:
            return None


def look_at(where: Remote) -> Seen | None:
    """Return what the store says of an object now; None where there is none.

    Raises:
        TooltipError: the store does not answer.
    """
    with store_errors(where, "looked at"):
        files, path = _open(where)
        files.invalidate_cache(files._parent(path))
        try:
            return _seen(files.info(path))
        except FileNotFoundError:
            return None


def _seen(info: Mapping[str, Any]) -> Seen:
    version = next((info[key] for key in _VERSION_KEYS if info.get(key)), "")
    return Seen(int(info.get("size") or 0), str(version))


def fetch(where: Remote, path: Path, expected: Seen | None = None) -> None:
    """Copy an object to this machine.

    Args:
        expected: what a listing said of it; another version is refused.

    Raises:
        TooltipError: it is not there, cannot be read, or is not what was expected.
    """
    with store_errors(where, "fetched"):
        files, key = _open(where)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            files.get_file(key, str(path))
        except OSError as error:
            if error.errno is not None and error.filename is not None:  # of this machine's disk
                raise TooltipError(
                    f"{where}: cannot be fetched to {path.parent} ({error.strerror}); TMPDIR may "
                    "name another place"
                ) from None
            raise
    if expected is None:
        return
    size = path.stat().st_size
    if look_at(where) != expected or size != expected.size:
        raise TooltipError(
            f"{where}: has changed since it was listed (then {expected.size} bytes, now {size}); "
            "run again"
        )


def write(where: Place, data: str | bytes) -> None:
    """Write a file or an object whole or not at all.

    An object is one request, which a store answers once it has every byte; above the provider's
    limit for that it is an upload in parts that becomes visible when it is completed.

    Raises:
        TooltipError: it cannot be written.
    """
    if isinstance(where, Path):
        write_whole(where, data)
        return
    with store_errors(where, "written"):
        files, path = _open(where)
        files.pipe_file(path, data.encode() if isinstance(data, str) else data)


@dataclass
class Listing:
    """What lies in the folders of buckets, each asked for once."""

    _folders: dict[str, dict[str, Seen]] = field(default_factory=dict)  # url -> name -> object
    _whole: list[str] = field(default_factory=list)  # urls of which everything below is known

    def add_tree(self, root: Remote) -> None:
        """Ask for everything below a folder, a thousand objects a request.

        Raises:
            TooltipError: the store does not answer, or there is no such bucket.
        """
        if self._knows(root.url):
            return
        with store_errors(root, "listed"):
            files, path = _open(root)
            files.invalidate_cache()
            for key, info in files.find(path, detail=True).items():
                below = key.removeprefix(path).strip("/")
                parent, _, name = f"{root.url}/{below}".rpartition("/")
                if name and info.get("type") != "directory":
                    self._folders.setdefault(parent, {})[name] = _seen(info)
            files.invalidate_cache()  # it keeps every listing, and memory with it
        self._whole.append(root.url)

    def folder(self, folder: Remote) -> Mapping[str, Seen]:
        """Return the objects of a folder by name.

        Raises:
            TooltipError: the store does not answer.
        """
        if folder.url not in self._folders and not self._knows(folder.url):
            found: dict[str, Seen] = {}
            with store_errors(folder, "listed"):
                files, path = _open(folder)
                files.invalidate_cache(path)
                try:
                    for info in files.ls(path, detail=True):
                        if info.get("type") != "directory":
                            found[info["name"].rpartition("/")[2]] = _seen(info)
                except FileNotFoundError:
                    pass
            self._folders[folder.url] = found
        return self._folders.get(folder.url, {})

    def _knows(self, url: str) -> bool:
        return any(url == root or url.startswith(f"{root}/") for root in self._whole)

    def below(self, root: Remote) -> Iterator[Remote]:
        """Yield the objects of a tree that was added, folder by folder in order."""
        for folder in sorted(self._folders):
            if folder == root.url or folder.startswith(f"{root.url}/"):
                for name in sorted(self._folders[folder]):
                    yield Remote(f"{folder}/{name}")
