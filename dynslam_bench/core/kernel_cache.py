"""Compiled kernels on disk: each file is named after what was compiled into it.

The name holds the digest of the kernel's code and of all that it uses, of the types of its
arguments, of numba, llvmlite, numpy and Python, and of the processor (see `core.kernel_code`).
Checkouts and environments of which all of this is equal share files; an edit of anything that is
compiled into a kernel leads to another file. Only whole files are used. See
``docs/decisions/kernel-cache.md``.
"""

import contextlib
import hashlib
import os
import pickle
import re
import time
from io import BytesIO
from pathlib import Path
from types import FunctionType

from numba.core.caching import CompileResultCacheImpl
from numba.core.compiler import Compiler
from numba.core.serialize import dumps

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.files import sweep_temporary, write_atomic
from dynslam_bench.core.folders import KERNEL_SUFFIX, kernels_folder
from dynslam_bench.core.kernel_code import (
    Foreign,
    NotDescribedError,
    kernel_digest,
    signature_digest,
)
from dynslam_bench.core.module_graph import PACKAGE, module_graph

UNUSED_S = 30 * 24 * 3600
"""Files that nobody has loaded for so long are removed: the kernels of one state of the sources take some 7 MB."""
_DIGITS = 32
"""Hexadecimal digits of each digest in a name: two of 10^9 states would share 32 with a probability of 10^-21."""

_NO_FOLDER = (OSError, RuntimeError)
"""Errors raised where sources cannot be read, or where the user has no home folder."""

KERNELS: dict[FunctionType, Foreign] = {}
"""The kernels of this process that may lie on disk, by their Python functions."""


def remember_kernel(kernel: Foreign) -> None:
    """Let a kernel be stored on disk and loaded from there.

    Args:
        kernel: What `numba.njit` made, with `KernelCompiler` as its ``pipeline_class``.
    """
    KERNELS[kernel.py_func] = kernel
    # the sources are read now: an edit between the import and the compilation of a module shows
    # (`source_digest`)
    with contextlib.suppress(*_NO_FOLDER):
        module_graph()


class KernelCompiler(Compiler):
    """Numba's compiler, which first looks for what was compiled before."""

    def compile_extra(self, func: FunctionType) -> Foreign:
        """Load or compile a kernel for the types in ``self.state``.

        Args:
            func: The kernel's Python function.
        """
        kernel = KERNELS[func]
        file = kernel_file(kernel, self.state.args, self.state.return_type, self.state.flags)
        if file is None:
            return super().compile_extra(func)

        content = _read(file)
        if content is not None:
            return _load(kernel, content)

        compiled = super().compile_extra(func)
        # code with "dynamic globals" holds addresses of this process
        if not compiled.lifted and not compiled.library.has_dynamic_globals:
            _store(file, self.state.args, compiled)
        return compiled


def load_kernels() -> None:
    """Load what lies on disk of all kernels, and with it the rest of numba.

    Processes that are forked from this one have it then; else each takes 0.4 s to load it. Kernels
    for types that are no longer defined are passed over.
    """
    files = sorted(kernels_folder().glob(f"*{KERNEL_SUFFIX}"))
    for kernel in list(KERNELS.values()):
        prefix = _name_prefix(kernel)
        for file in files:
            content = _read(file) if prefix and file.name.startswith(prefix) else None
            if content is None:
                continue
            # the first of the two objects in it: the types, of which another version's may be gone
            with contextlib.suppress(AttributeError, ImportError):
                kernel.compile(pickle.loads(content))


# -- names -----------------------------------------------------------------------------------------


def kernel_file(
    kernel: Foreign, arguments: tuple[Foreign, ...], return_type: Foreign, flags: Foreign
) -> Path | None:
    """Path of a kernel that is compiled for some types; None if it is compiled in memory only.

    Args:
        kernel: One of `KERNELS`.
        arguments: Numba's types of the arguments, see `signature_digest`.
        return_type: Numba's type of the result, see `signature_digest`.
        flags: Numba's flags of this compilation, see `signature_digest`.
    """
    prefix = _name_prefix(kernel)
    if not prefix:
        return None
    try:
        signature = signature_digest(arguments, return_type, flags)
        return kernels_folder() / f"{prefix}{signature[:_DIGITS]}{KERNEL_SUFFIX}"
    except (NotDescribedError, *_NO_FOLDER):
        return None


def _name_prefix(kernel: Foreign) -> str:
    """Beginning of the names of a kernel's files; empty if it is compiled in memory only."""
    function = kernel.py_func
    name = f"{function.__module__}.{function.__qualname__}".removeprefix(f"{PACKAGE}.")
    readable = re.sub("[^A-Za-z0-9_.]", "", name)[-100:]
    try:
        return f"{readable}-{kernel_digest(kernel)[:_DIGITS]}-"
    except (NotDescribedError, *_NO_FOLDER):
        return ""


# -- files -----------------------------------------------------------------------------------------


class _Serializer(CompileResultCacheImpl):
    """Numba's conversion of compiled code to what can be written and back, without its choice of a folder."""

    def __init__(self) -> None:
        pass


def _read(file: Path) -> bytes | None:
    """The compiled kernel in a file; None if it is missing, cut off, damaged or was written under another name."""
    try:
        header, _, content = file.read_bytes().partition(b"\n")
    except OSError:
        return None
    if header != _header(file, content):
        return None
    with contextlib.suppress(OSError):  # a folder that can only be read
        os.utime(file)
    return content


def _header(file: Path, content: bytes) -> bytes:
    """The first line of a file: its name, and the SHA-256 of what follows."""
    return f"{file.name} {hashlib.sha256(content).hexdigest()}".encode()


def _load(kernel: Foreign, content: bytes) -> Foreign:
    """Make what a file holds a compiled function of this process."""
    stream = BytesIO(content)
    pickle.load(stream)  # the types, which `load_kernels` reads
    context = kernel.targetctx
    context.refresh()
    compiled = _Serializer().rebuild(context, pickle.load(stream))
    # kernels that are compiled later may call it
    context.insert_user_function(compiled.entry_point, compiled.fndesc, [compiled.library])
    return compiled


def _store(file: Path, arguments: tuple[Foreign, ...], compiled: Foreign) -> None:
    """Write compiled code; where that is not possible, the next process compiles it again."""
    remove_unused(file.parent, time.time())
    content = dumps(arguments) + dumps(_Serializer().reduce(compiled))
    with contextlib.suppress(DynslamError):
        write_atomic(file, _header(file, content) + b"\n" + content)


def remove_unused(folder: Path, now: float) -> None:
    """Remove the kernels that nobody has loaded for `UNUSED_S`, and what killed processes left half-written.

    Args:
        folder: Folder of the compiled kernels; it may be missing.
        now: The time, in seconds since the epoch.
    """
    sweep_temporary(folder)
    for file in folder.glob(f"*{KERNEL_SUFFIX}"):
        # another process has removed it, or the folder can only be read
        with contextlib.suppress(OSError):
            if now - file.stat().st_mtime > UNUSED_S:
                file.unlink()
