"""CMA-ES without the run of code: Optuna keeps its state in the study's storage as a pickle.

Whoever can write to the storage could put any other pickle there, and reading it would run what it names. Here it is
read with nothing but the classes that such a state is made of, all of which only hold numbers.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from typing import Any

from optuna.samplers import _cmaes as optuna_cmaes

from dynslam_bench.core.errors import StudyError

_NUMPY = ("numpy._core", "numpy.core")
_ALLOWED = {
    ("cmaes._cma", "CMA"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    *((f"{core}.multiarray", name) for core in _NUMPY for name in ("_reconstruct", "scalar")),
    *((f"{core}.numeric", "_frombuffer") for core in _NUMPY),
}


class _State(pickle.Unpickler):
    """Reads a state of CMA-ES and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it names {module}.{name}")
        return super().find_class(module, name)


class _OnlyStates:
    """Stands in for the module ``pickle`` where Optuna's CMA-ES reads its state."""

    dumps = staticmethod(pickle.dumps)

    @staticmethod
    def loads(data: bytes) -> Any:
        try:
            for operation, argument, _ in pickletools.genops(data):
                if operation.name in ("PUT", "LONG_BINPUT") and int(argument or 0) > len(data):
                    raise pickle.UnpicklingError(f"it asks for room for {argument} objects")
            return _State(io.BytesIO(data)).load()
        except Exception as error:  # a pickle that somebody made can raise whatever it likes
            raise StudyError(
                f"the study's storage holds no state of CMA-ES but something else: {str(error)[:200]}",
                "it was tampered with or is damaged; use another sampler, or a storage of your own",
            ) from error


def restrict() -> None:
    """Let Optuna's CMA-ES restore nothing but its own state, in this process.

    Raises:
        StudyError: This Optuna reads its state in another way, which is not known to be safe.
    """
    if not hasattr(optuna_cmaes, "pickle"):
        raise StudyError("sampler 'cmaes' is not known to be safe with this version of Optuna", "use tpe or gp")
    optuna_cmaes.pickle = _OnlyStates
