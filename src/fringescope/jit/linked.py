"""Kernels out of Numba's cache, linked as they are: what Numba needs to compile waits until something must be compiled.

The files are Numba's own, and whatever in them is not as expected is left to Numba.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import pickle
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numba
from llvmlite import binding
from numba.core.caching import FunctionCache, NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.environment import Environment, lookup_environment
from numba.core.runtime import _nrt_python


def linked(function: Callable[..., Any], **options: Any) -> Any:
    """`numba.njit(cache=True, **options)`, with the cache below."""
    kernel = numba.njit(**options)(function)
    if isinstance(getattr(kernel, "_cache", None), NullCache):  # NUMBA_DISABLE_JIT leaves the function itself
        kernel._cache = _Cache(function)
        kernel._compilation_chain_init_hook = _nothing  # what it does, Numba does again before it compiles
    return kernel


def _nothing() -> None:
    """Looks for no extensions of Numba."""


class _Cache(FunctionCache):  # type: ignore[misc]
    """Numba's cache of one function; where its files lie is settled when they are asked for."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "_cache_file" in self.__dict__:
            raise AttributeError(name)
        super().__init__(self._function)
        return getattr(self, name)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel for the types of its arguments, or None. Files that cannot be read are thrown away."""
        try:
            found = self._linked(sig, target_context)
        except Exception:  # files that are damaged, or made otherwise
            found = None
        if found is not None:
            return found
        try:
            return super().load_overload(sig, target_context)
        except Exception:
            with contextlib.suppress(OSError):
                Path(self._cache_file._index_path).unlink(missing_ok=True)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a kernel; where the disk is full it is compiled again the next time."""
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)

    def _linked(self, sig: Any, target_context: Any) -> Any:
        name = self._cache_file._load_index().get(self._index_key(sig, target_context.codegen()))
        if name is None:
            return None
        data = Path(self._cache_file._data_path(name)).read_bytes()
        parts = _Reader(io.BytesIO(data)).load()
        return _link(target_context, parts) if _as_expected(parts) else None


def _as_expected(parts: Any) -> bool:
    """Is it a kernel's machine code, which needs nothing but the runtime?"""
    if not (isinstance(parts, tuple) and len(parts) == 9):
        return False
    library, _, _, _, object_mode, lifted, _, reload_init, _ = parts
    return library[1] == "object" and not (object_mode or lifted or reload_init)


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numba.core.environment", "_rebuild_env"):
            return _environment
        return super().find_class(module, name)


def _environment(module: str, constants: Sequence[Any], name: str) -> Any:
    """As Numba's own, but for the module of one of Numba's functions, whose globals compiled code has no use for."""
    env = lookup_environment(name)
    if env is None:
        there = sys.modules.get(module)
        if there is None and not module.startswith("numba."):
            there = importlib.import_module(module)
        env = Environment({"__name__": module} if there is None else there.__dict__)
        env.consts[:] = constants
        env.env_name = name
        Environment._memo[name] = env
    return env


class _Library(JITCodeLibrary):  # type: ignore[misc]
    """Machine code, with the intermediate code for kernels that are compiled later and call this one."""

    intermediate: bytes | None = None

    @property
    def _shared_module(self) -> Any:
        if self.intermediate is not None:
            module = self.__dict__["shared"] = binding.parse_bitcode(self.intermediate)
            self.intermediate = None
            self._codegen._engine._load_defined_symbols(module)
        return self.__dict__.get("shared")

    @_shared_module.setter
    def _shared_module(self, module: Any) -> None:
        self.__dict__["shared"] = module


@functools.cache
def _runtime() -> None:
    """Numba's runtime: the addresses of what kernels call."""
    helpers: Mapping[str, int] = _nrt_python.c_helpers
    for name, address in helpers.items():
        binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


def _link(target_context: Any, parts: tuple[Any, ...]) -> Any:
    """What `CompileResult._rebuild` makes of a kernel's parts."""
    _runtime()
    (name, _, (code, intermediate)), description, env, signature, object_mode, lifted, types, init, others = parts
    codegen = target_context.codegen()
    library = _Library(codegen, name)
    library.enable_object_caching()
    library._set_compiled_object(code)
    library.intermediate = intermediate
    library._finalize_final_module()
    codegen._engine._defined_symbols |= {description.llvm_func_name, description.llvm_cpython_wrapper_name}
    entry = target_context.get_executable(library, description, env)
    for other in others:
        codegen.set_env(other.env_name, other)
    return CompileResult(
        target_context=target_context, typing_context=target_context.typing_context, library=library, environment=env,
        entry_point=entry, fndesc=description, type_annotation=types, signature=signature, objectmode=object_mode,
        lifted=lifted, typing_error=None, call_helper=None, metadata=None, reload_init=init, referenced_envs=others,
    )  # fmt: skip
