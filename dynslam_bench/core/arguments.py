"""One line for a call that Python cannot make sense of: which argument is of a wrong type, and what it should be."""

import inspect
import re
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from typing import Any, TypeVar, cast, get_type_hints

from pydantic import ConfigDict, ValidationError, create_model

from dynslam_bench.core.errors import DynslamError, SettingsError
from dynslam_bench.core.settings import shown

Target = TypeVar("Target", bound=Callable[..., Any])


def names_wrong_arguments(target: Target) -> Target:
    """Decorate a function, or a class for its constructor: when it fails, arguments are compared with annotations.

    Raises:
        SettingsError: The call failed and an argument is not of the annotated type. Other errors
            pass as they are.
    """
    if isinstance(target, type):
        target.__init__ = names_wrong_arguments(target.__init__)  # type: ignore[misc]
        return target

    @wraps(target)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return target(*args, **kwargs)
        except DynslamError:
            raise
        except Exception as error:
            wrong = None
            # `bind` raises where names do not fit, and the check where an annotation cannot be
            # checked: then the first error stands
            with suppress(Exception):
                if _is_of_this_package(error):
                    arguments = inspect.signature(target).bind(*args, **kwargs).arguments
                    wrong = _wrong_argument(target, arguments)
            if wrong is not None:
                raise wrong from error
            raise

    return cast("Target", call)


def _is_of_this_package(error: Exception) -> bool:
    """Whether an error passed through this package and its libraries alone: no plug-in, nor a user's callable."""
    packages = set()
    for frame, _ in traceback.walk_tb(error.__traceback__):
        module = str(frame.f_globals.get("__name__"))
        packages.add(module.partition(".")[0])
    this_package = __name__.partition(".")[0]
    return packages <= {this_package, "gymnasium", "numpy", *sys.stdlib_module_names}


def _wrong_argument(function: Callable[..., Any], given: dict[str, Any]) -> SettingsError | None:
    """The line on the first argument that is not of the annotated type; None if all are.

    Args:
        function: The function.
        given: The arguments of a call by name.
    """
    # pydantic compares: a model with one field for each argument
    hints = get_type_hints(function)
    fields: dict[str, Any] = {name: (hints[name], ...) for name in given if name in hints}
    model = create_model(
        "Arguments", __config__=ConfigDict(arbitrary_types_allowed=True, strict=True), **fields
    )
    try:
        model.model_validate({name: given[name] for name in fields})
    except ValidationError as wrong:
        name = str(wrong.errors()[0]["loc"][0])
        annotation = inspect.signature(function).parameters[name].annotation
        expected = inspect.formatannotation(annotation)
        expected = re.sub(r"\b(\w+\.)+", "", expected).strip("'")  # without the modules
        return SettingsError(f"{name} is {shown(given[name])}", f"give {expected}")
    return None
