"""Functions that numba compiles; numba, a slow import, comes with the first call."""

import functools
from collections.abc import Callable
from typing import Any

from bcrl.errors import BcrlError


class Compiled:
    """A function that numba compiles when it, or compiled code that uses it, is called.

    Every attribute is that of numba's dispatcher, so numba takes it for one.
    """

    def __init__(self, function: Callable, options: dict[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self._function, self._options = function, options

    def __reduce__(self) -> tuple:  # it is compiled anew in another process
        return type(self), (self._function, self._options)

    @functools.cached_property
    def _dispatcher(self) -> Any:
        from bcrl.common import numba_cache  # a large import

        return numba_cache.njit(self._function, self._options)

    def __call__(self, *arguments: Any) -> Any:
        return self._dispatcher(*arguments)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._dispatcher, name)


def compiled(**options: Any) -> Callable[[Callable], Any]:
    """A decorator like numba.njit."""
    return lambda function: Compiled(function, options)


def kept(function: Any = None, **options: Any) -> Any:
    """A decorator like numba.njit whose compiled code is kept on disk if possible."""
    decorator = compiled(cache=True, **options)
    return decorator if function is None else decorator(function)


def instructions(function: Callable) -> Callable:
    """A decorator: the function builds the LLVM code for calls of itself."""
    from numba import extending  # a large import

    return extending.intrinsic(function)


def check() -> None:
    """Raise BcrlError if numba may not compile: some loops need it."""
    import numba  # a large import

    if numba.config.DISABLE_JIT:
        raise BcrlError("NUMBA_DISABLE_JIT=1: unset it, bcrl's loops must be compiled")


def cpu_features() -> set[str]:
    """Features of the processor that numba compiles for, such as "+avx2"."""
    from numba.core import codegen, config  # a large import

    given = config.CPU_FEATURES  # type: ignore[attr-defined]
    names = codegen.get_host_cpu_features() if given is None else given
    return set(names.split(","))
