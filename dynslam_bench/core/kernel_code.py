"""Digest of the code that is compiled into a kernel.

A kernel's machine code holds the kernels that it calls, the constants that they use, wherever these
are defined, and vector instructions. Kernels and constants are described as they are in
memory when the kernel is compiled: by bytecode and value, without comments, docstrings and line
numbers. What only numba can look into (its types, instructions in LLVM's language) is described by
the source of its module and of all that this module imports.
"""

import hashlib
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from functools import cache
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeAlias

import llvmlite
import numba
import numpy as np
from numba.extending import is_jitted

from dynslam_bench.core.module_graph import PACKAGE, module_graph, read_module_graph

Foreign: TypeAlias = Any
"""A kernel, type or flag of numba, which has no annotations."""

Described: TypeAlias = dict[Any, int]
"""Kernels and modules that are described already, by their `id`, with a running number in the order of description."""

VERSIONED = {"numba", "llvmlite", "numpy", *sys.stdlib_module_names}
"""Packages whose versions are part of every digest: what they define is described by its name."""
NO_CODE = (
    "CACHE",
    "COLOR",
    "CUDA",
    "DEBUG_CACHE",
    "DISABLE_PERFORMANCE",
    "NUMBA",
    "SHOW_HELP",
    "THREADING",
)
"""Beginning of those settings of numba that do not change what is compiled."""
_PLAIN = (bool, int, float, complex, str, bytes, type(None), type(...))
"""Types of values that their `repr` tells completely."""


class NotDescribedError(Exception):
    """A kernel uses something whose content cannot be told."""


def kernel_digest(kernel: Foreign) -> str:
    """SHA-256 of what is compiled into a kernel, and of what it is compiled by and for.

    Args:
        kernel: A function that numba compiles.

    Raises:
        NotDescribedError: Something that it uses cannot be described.
        OSError: A source cannot be read.
    """
    return _digest([*_target_words(kernel), *_kernel_words(kernel, {})])


def signature_digest(arguments: tuple[Foreign, ...], return_type: Foreign, flags: Foreign) -> str:
    """SHA-256 of the types that a kernel is compiled for.

    Args:
        arguments: Numba's types of the arguments.
        return_type: Numba's type of the result, where the caller asks for one; else None.
        flags: Numba's flags of this compilation: a kernel takes over some of the kernel that calls
            it.

    Raises:
        NotDescribedError: One of the types cannot be described.
        OSError: A source cannot be read.
    """
    words = [str(return_type)]
    words += [f"{name}={value}" for name, value in sorted(flags.values().items())]
    for kind in arguments:
        words += _type_words(kind)
    return _digest(words)


def _digest(words: Iterable[str]) -> str:
    """SHA-256 of words; each counts with its length, so that no two lists of words are the same text."""
    state = hashlib.sha256()
    for word in words:
        state.update(f"{len(word)} {word}\n".encode(errors="surrogatepass"))
    return state.hexdigest()


def _target_words(kernel: Foreign) -> Iterator[str]:
    """Versions, processor and settings of numba."""
    yield from (numba.__version__, llvmlite.__version__, np.__version__)
    yield str(sysconfig.get_config_var("SOABI") or sys.implementation.cache_tag)
    # operating system, processor and its instructions
    yield repr(kernel.targetctx.codegen().magic_tuple())
    for name, value in sorted(vars(numba.config).items()):
        if name.isupper() and not name.startswith(NO_CODE):
            yield f"{name}={value!r}"


def _kernel_words(kernel: Foreign, described: Described) -> Iterator[str]:
    """A kernel with its options and all that it uses; one that is met again is described by its number alone."""
    function = kernel.py_func
    is_described = id(function) in described
    number = described.setdefault(id(function), len(described))
    yield f"kernel {function.__module__}.{function.__qualname__} {number}"
    if not is_described:
        yield repr(sorted(kernel.targetoptions.items()))
        yield from _function_words(function, described)


def _function_words(function: FunctionType, described: Described) -> Iterator[str]:
    """A function's bytecode, defaults, enclosed variables, and the globals that it names."""
    codes = list(_with_inner_code(function.__code__))
    for code in codes:
        yield from _code_words(code, function.__doc__)

    # what the function holds: defaults of its arguments, variables of the function around it
    try:
        enclosed = tuple(cell.cell_contents for cell in function.__closure__ or ())
    except ValueError as error:
        raise NotDescribedError(
            f"{function.__qualname__} uses a variable that has no value yet"
        ) from error
    yield from _value_words((function.__defaults__, enclosed), (), described)
    yield from _value_words(tuple(sorted((function.__kwdefaults__ or {}).items())), (), described)

    # what it takes from its module; names of attributes are among them, for modules that it uses
    names = tuple(sorted({name for code in codes for name in code.co_names}))
    for name in names:
        if name in function.__globals__:
            yield name
            yield from _value_words(function.__globals__[name], names, described)


def _with_inner_code(code: CodeType) -> Iterator[CodeType]:
    """A function's code and that of the functions and comprehensions in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _with_inner_code(constant)


def _code_words(code: CodeType, docstring: str | None) -> Iterator[str]:
    """Words for everything in a function's byte code that decides what it computes, without line numbers."""
    yield code.co_code.hex()
    yield getattr(code, "co_exceptiontable", b"").hex()  # Python 3.10 has none
    yield repr((code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags))
    yield repr((code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars))
    for constant in code.co_consts:
        if constant is None or constant == docstring:
            yield "None"  # the place of a docstring holds None if there is none
        elif isinstance(constant, CodeType):
            yield "inner code"
        else:
            yield from _constant_words(constant)


def _constant_words(constant: Any) -> Iterator[str]:
    """A constant in bytecode; sets have no order of their own."""
    if isinstance(constant, frozenset):
        yield f"frozenset {sorted(map(repr, constant))}"
    elif isinstance(constant, tuple):
        yield f"tuple {len(constant)}"
        for element in constant:
            yield from _constant_words(element)
    else:
        yield f"{type(constant).__name__} {constant!r}"


def _value_words(value: Any, names: tuple[str, ...], described: Described) -> Iterator[str]:
    """A value that a kernel uses.

    Args:
        value: The value.
        names: The names in the kernel's code: those are described that it may take from a module.
        described: What is described already.
    """
    if type(value) in _PLAIN:
        yield f"{type(value).__name__} {value!r}"
    elif is_jitted(value):
        yield from _kernel_words(value, described)
    elif isinstance(value, ModuleType):
        yield from _module_words(value, names, described)
    elif isinstance(value, tuple):
        yield from _tuple_words(type(value), described)
        yield str(len(value))
        for element in value:
            yield from _value_words(element, names, described)
    elif isinstance(value, type) and issubclass(value, tuple):
        yield from _tuple_words(value, described)
    elif isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
        yield f"array {value.dtype!r} {value.shape} {value.strides} {value.tobytes().hex()}"
    elif isinstance(value, np.dtype):
        yield f"dtype {value!r}"
    elif isinstance(value, numba.types.Type):
        yield from _type_words(value)
    else:
        yield from _named_words(value)


def _module_words(
    module: ModuleType, names: tuple[str, ...], described: Described
) -> Iterator[str]:
    """A module that a kernel uses, with those of its attributes that the kernel's code names."""
    yield f"module {module.__name__}"
    is_versioned = module.__name__.partition(".")[0] in VERSIONED
    if is_versioned or (id(module), names) in described:
        return
    described[id(module), names] = len(described)
    for name in names:
        if hasattr(module, name):
            yield name
            yield from _value_words(getattr(module, name), names, described)


def _tuple_words(kind: type, described: Described) -> Iterator[str]:
    """A class of tuples: `tuple` itself or a `NamedTuple`."""
    yield f"tuple {kind.__module__}.{kind.__qualname__} {getattr(kind, '_fields', ())}"
    for name, default in getattr(kind, "_field_defaults", {}).items():
        yield name
        yield from _value_words(default, (), described)


def _type_words(kind: Foreign) -> Iterator[str]:
    """One of numba's types."""
    if isinstance(kind, numba.types.Callable):
        raise NotDescribedError(f"a function as an argument: {kind}")
    yield f"type {kind}"
    if isinstance(kind, numba.types.BaseNamedTuple):
        yield from _tuple_words(kind.instance_class, {})
    if isinstance(kind, numba.types.BaseTuple):
        for inner in kind.types:
            yield from _type_words(inner)
    yield from _named_words(type(kind))


def _named_words(value: Any) -> Iterator[str]:
    """Something that is described by where it is defined.

    Raises:
        NotDescribedError: It has no name there, or is neither this package's nor a versioned one's.
    """
    module = getattr(value, "__module__", None) or type(value).__module__
    top_level = module.partition(".")[0]
    names: list[str] = []
    if top_level == PACKAGE:
        # one inner function may make several instructions: they differ by the names that their
        # module gives them
        names = sorted(name for name, other in vars(sys.modules[module]).items() if other is value)
        yield source_digest(module)
    elif top_level in VERSIONED:
        name = str(getattr(value, "__qualname__", None) or getattr(value, "__name__", "<unknown>"))
        if "<" not in name:  # <locals>, <lambda>, <unknown>
            names = [name]
    if not names:
        raise NotDescribedError(f"{value!r} of {module}")
    yield f"{module} {names}"


@cache
def source_digest(module: str) -> str:
    """The digest of a module's source and of all that it imports, see `core.module_graph`.

    Args:
        module: One that is imported already.

    Raises:
        NotDescribedError: Its source has changed since this process first looked at the sources, so
            that it may not be what was imported; or it is none of this package's sources.
        OSError: A source cannot be read.
    """
    digest = module_graph().digest([module])
    if module not in module_graph().modules or read_module_graph().digest([module]) != digest:
        raise NotDescribedError(f"{module} has changed since it was imported")
    return digest
