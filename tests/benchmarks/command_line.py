"""The command lines of the benchmarks: options are named, typed and repeated as their defaults are."""

import argparse
from typing import Any


def parser_of(doc: str | None, **options: Any) -> argparse.ArgumentParser:
    """A parser with these options; what it takes besides is added to it.

    Args:
        doc: The script's docstring.
        options: Defaults by name: a list takes several values, False is a switch, a type stands for no default.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in options.items():
        several = isinstance(default, (list, tuple))
        kind = default if isinstance(default, type) else type(default[0] if several else default)
        how: dict[str, Any] = {"action": "store_true"} if default is False else {"type": kind}
        how |= {"nargs": "+"} if several else {}
        how |= {} if isinstance(default, type) else {"default": default}
        parser.add_argument(f"--{name.replace('_', '-')}", **how)
    return parser
