"""Compilation of kernels with numba, typed and cached, for callers that hold numba's arrays.

Such kernels live in modules named ``_*_numba.py``, which import numba at the top, and their callers
import them where they run. `machine_code` does the same without numba in later processes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar

_LOGGER = logging.getLogger(__name__)

_Function = TypeVar("_Function", bound=Callable[..., Any])


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
