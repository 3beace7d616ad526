"""Machine code of the detector's kernels, kept on disk and loaded without numba.

Importing numba and making it ready to load its own caches takes half a second of processor time,
as much as detecting in a hundred images. So numba compiles a kernel once, to C's calling
convention; later processes need only llvmlite, which links the object file in a tenth of that.

Kernels live in modules named ``_*_numba.py``, which import numba at the top and are imported here,
when there is something to compile.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import importlib
import importlib.util
import logging
import os
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

_LOGGER = logging.getLogger(__name__)
_LOCK = threading.Lock()  # one thread compiles or links, the others wait for what it makes
_ENGINES: list[Any] = []  # linked code lives as long as its engine

# spelling -> name of numpy's, numba's and ctypes' type
_TYPES = {
    "u8": "uint8",
    "u16": "uint16",
    "i32": "int32",
    "i64": "int64",
    "f32": "float32",
    "f64": "float64",
}
_BEGINNING = ctypes.c_char * 0  # of an array
_SCALARS = {"i64": ctypes.c_int64, "f64": ctypes.c_double}

# What a kernel must not call: symbols that exist only where numba has been imported.
_OUTSIDE = re.compile(r"\bcall\b[^\n]*@(NRT_|numba_|Py)")


_Result = TypeVar("_Result")


def fast_or_slow(
    fast: Callable[[], _Result], slow: Callable[[], _Result], wanted: bool | None
) -> _Result:
    """Return what the compiled form gives, or the plain numpy one, which gives the same.

    Args:
        wanted: whether to run the compiled form; None takes it where there is one, and says once,
            as a warning, that there is none.

    Raises:
        ImportError: it is wanted, and there is none.
    """
    if wanted is False:
        return slow()
    try:
        return fast()
    except ImportError as error:
        if wanted:
            raise
        _say_slow(str(error))
    return slow()


@functools.cache
def _say_slow(obstacle: str) -> None:
    _LOGGER.warning(
        "%s: detection and estimation fall back to plain numpy, which gives the same answers up to "
        "a hundred times slower",
        obstacle,
    )


class Kept:
    """An array that many calls of a kernel take, whose address is found once.

    Finding it takes longer than matching ten edges. Nobody checks its type when it is given.
    """

    def __init__(self, array: np.ndarray[Any, Any]) -> None:
        self.array, self.address = array, ctypes.c_void_p(array.ctypes.data)


class Scratch(threading.local):
    """Scratch space that every thread keeps for its next call of a kernel."""

    def __init__(self) -> None:
        self._kept: dict[object, tuple[Kept, ...]] = {}

    def __call__(
        self, key: object, make: Callable[[], tuple[np.ndarray[Any, Any], ...]]
    ) -> tuple[Kept, ...]:
        """Return what ``make`` returned when this thread first asked for ``key``."""
        kept = self._kept.get(key)
        if kept is None:
            kept = self._kept[key] = tuple(map(Kept, make()))
        return kept


@functools.cache
def cpu_features() -> frozenset[str]:
    """Return the instruction sets of this processor, by LLVM's names.

    Raises:
        ImportError: llvmlite cannot be imported.
    """
    import llvmlite.binding as llvm

    return frozenset(name for name, there in llvm.get_host_cpu_features().items() if there)


def kernel(module: str, name: str, signature: str, *constants: int) -> Callable[..., int]:
    """Return a kernel as machine code; it releases the interpreter lock while it runs.

    The code is kept on disk, keyed by its module's source, by the compiler's versions and by the
    processor. Where no folder is writable it is compiled anew in every process.

    Args:
        module: absolute name; its function ``name`` takes the constants and returns the Python
            function to compile, which returns an integer.
        signature: its arguments' types, separated by blanks: u8, u16, i32, i64, f64, with ``*`` for
            the address of an array. Arrays are given as numpy arrays, C-contiguous and of that
            type, and are checked when the kernel is called; or as `Kept`.

    Raises:
        ImportError: there is no such code yet and numba cannot be imported, or it is switched off.
    """
    with _LOCK:
        return _kernel(module, name, signature, constants)


@functools.cache
def _kernel(
    module: str, name: str, signature: str, constants: tuple[int, ...]
) -> Callable[..., int]:
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        raise ImportError("numba's compiler is switched off (NUMBA_DISABLE_JIT)")
    key = _key(module, name, signature, constants)
    file = f"{module.rpartition('.')[2]}.{name}.{key[:24]}.o"
    places = [folder / file for folder in _folders()]
    for place in places:
        stored = _read(place)
        if stored is not None:
            return _callable(signature, _link(*stored))
    symbol, code, address = _compile(module, name, signature, constants)
    if code is None:
        return _callable(signature, address)
    if not any(_written(place, symbol, code) for place in places):
        _LOGGER.info("no folder for compiled kernels is writable; compiling for this run only")
    return _callable(signature, _link(symbol, code))


def _key(module: str, name: str, signature: str, constants: tuple[int, ...]) -> str:
    import llvmlite.binding as llvm

    version = _version_of_numba()
    spec = importlib.util.find_spec(module)
    assert spec is not None  # noqa: S101  (the callers name modules of this package)
    sha = hashlib.sha256()
    for file in (__file__, spec.origin):
        sha.update(Path(str(file)).read_bytes())
    host = (llvm.get_process_triple(), llvm.get_host_cpu_name(), sorted(cpu_features()))
    versions = (version, llvm.llvm_version_info)
    sha.update(repr((name, signature, constants, versions, host)).encode())
    return sha.hexdigest()


def _version_of_numba() -> str:
    """Return the version that is installed, as its folder says where it can.

    Importing what looks it up by the book takes as long as detecting in ten images.
    """
    spec = importlib.util.find_spec("numba")
    if spec is None or spec.origin is None:
        raise ImportError("numba cannot be imported (it is not installed)")
    found = list(Path(spec.origin).parents[1].glob("numba-*.dist-info"))
    if len(found) == 1:
        return found[0].stem.removeprefix("numba-")
    from importlib.metadata import version

    return version("numba")


def _folders() -> list[Path]:
    """Return where compiled kernels may lie: beside the source, else in the user's cache."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    if named:
        return [Path(named)]
    users = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return [Path(__file__).parent / "__pycache__", Path(users).expanduser() / "tooltip"]


def _read(place: Path) -> tuple[str, bytes] | None:
    """Return the symbol and the object file at a place, if they are whole."""
    try:
        digest, symbol, code = place.read_bytes().split(b"\n", 2)
    except (OSError, ValueError):
        return None
    whole = hashlib.sha256(symbol + code).hexdigest().encode() == digest
    return (symbol.decode(), code) if whole else None


def _written(place: Path, symbol: str, code: bytes) -> bool:
    digest = hashlib.sha256(symbol.encode() + code).hexdigest()
    temporary = place.with_name(f".{place.name}.{os.getpid()}")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(f"{digest}\n{symbol}\n".encode() + code)
        temporary.replace(place)  # whole or not at all: other processes may be reading
    except OSError:
        return False
    return True


def _compile(
    module: str, name: str, signature: str, constants: tuple[int, ...]
) -> tuple[str, bytes | None, int]:
    """Return the symbol, the object file and numba's own address of a kernel.

    There is no object file where the code would not run without numba.
    """
    import llvmlite.binding as llvm
    import numba
    from numba import types

    arguments = [
        types.CPointer(getattr(types, _TYPES[kind[:-1]]))
        if kind.endswith("*")
        else getattr(types, _TYPES[kind])
        for kind in signature.split()
    ]
    function = getattr(importlib.import_module(module), name)(*constants)
    # inlined into its wrapper for C, a kernel that cannot raise leaves none of the wrapper's care
    options = {"nopython": True, "error_model": "numpy", "forceinline": True}
    compiled = numba.cfunc(types.int64(*arguments), **options)(function)
    _ENGINES.append(compiled)
    text = compiled.inspect_llvm()
    if _OUTSIDE.search(text):
        _LOGGER.info("%s is compiled anew in every process: it needs numba to run", name)
        return compiled.native_name, None, compiled.address
    code = _machine(llvm).emit_object(llvm.parse_assembly(text))
    return compiled.native_name, code, compiled.address


def _machine(llvm: Any) -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        codemodel="jitdefault",
        jit=True,
    )


def _link(symbol: str, code: bytes) -> int:
    """Return the address of a function in an object file, linked into this process."""
    import llvmlite.binding as llvm

    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine(llvm))
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    return int(engine.get_function_address(symbol))


def _callable(signature: str, address: int) -> Callable[..., int]:
    arguments: list[Any] = [
        _address(np.dtype(_TYPES[kind[:-1]])) if kind.endswith("*") else _SCALARS[kind]
        for kind in signature.split()
    ]
    return ctypes.CFUNCTYPE(ctypes.c_int64, *arguments)(address)


def _address(kind: np.dtype[Any]) -> Any:
    """Return what ctypes makes an address of an array with; numpy's own takes ten times as long."""

    start = _BEGINNING.from_buffer

    class Address:
        @staticmethod
        def from_param(array: Any) -> Any:  # an ndarray, or Kept
            if array.__class__ is Kept:
                return array.address
            flags = array.flags
            if array.dtype != kind or not flags.c_contiguous:
                raise TypeError(f"expected a contiguous array of {kind}, not {array.dtype}")
            if flags.writeable:
                return start(array)  # a quarter of the time of the other way
            return ctypes.c_void_p(array.ctypes.data)

    return Address
