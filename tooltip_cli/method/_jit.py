"""Compilation of kernels with numba, typed and cached, for the modules that also have a numpy form.

Kernels live in modules named ``_*_numba.py``, which import numba at the top; only code that has
asked `numba_available` may import those.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any, TypeVar

_LOGGER = logging.getLogger(__name__)

_Function = TypeVar("_Function", bound=Callable[..., Any])


@functools.cache
def numba_available() -> bool:
    """Return whether numba can compile; says once, as a warning, that it cannot.

    Importing numba takes about 0.2 s, which is why nothing imports it before it is needed.
    """
    try:
        import numba
    except ImportError as error:
        obstacle = f"numba cannot be imported ({error})"
    else:
        if not numba.config.DISABLE_JIT:
            return True
        obstacle = "numba's compiler is switched off (NUMBA_DISABLE_JIT)"
    _LOGGER.warning(
        "%s: the detector falls back to plain numpy, which gives the same answers about a "
        "hundred times slower",
        obstacle,
    )
    return False


def compiled(function: _Function, signature: Any) -> _Function:
    """Return the machine code of `function` for one numba signature.

    The code is kept on disk, keyed by source and by the processor's features, and releases the
    interpreter lock while it runs. Where no cache folder is writable it is compiled anew in every
    process. Divisions by zero give infinity or nan as in numpy.

    Args:
        function: what numba shall compile.
        signature: the numba types of its arguments and of its result.
    """
    import numba

    options = {"nogil": True, "error_model": "numpy"}
    try:
        machine_code: _Function = numba.njit(signature, cache=True, **options)(function)
    except RuntimeError as error:  # numba's word for "neither __pycache__ nor ~/.cache is writable"
        if "no locator available" not in str(error):
            raise
        _LOGGER.info("no folder for compiled kernels is writable; compiling for this run only")
        machine_code = numba.njit(signature, **options)(function)
    return machine_code
