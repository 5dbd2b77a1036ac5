"""Scripts: the examples of the package, and files of the user's, found by their names and called."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import importlib.util
import inspect
import pkgutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from lieint_jax import examples

_MARK = "__lieint_script__"  # an attribute of modules of scripts, which another one may replace
_PACKAGE = Path(__file__).parents[1]


class ScriptError(Exception):
    """An error in a script of the user's; its traceback begins at the script's own line."""

    def __init__(self, error: BaseException) -> None:
        super().__init__(str(error))
        self.error = error


def names() -> list[str]:
    """The names of the examples."""
    return sorted(module.name for module in pkgutil.iter_modules(examples.__path__))


def example(name: str) -> Any:
    """The module of an example; ValueError if there is none of this name."""
    if name in names():
        return importlib.import_module(f"{examples.__name__}.{name}")
    near = difflib.get_close_matches(name, names(), 1, 0.6)
    meant = f"did you mean {near[0]}? " if near else ""
    raise ValueError(f"there is no example {name!r}: {meant}`lieint list` shows all; or give a file NAME.py")


def find(name: str) -> Any:
    """The module of an example, or of a file NAME.py, which has a function `main`.

    Raises:
        ValueError: there is none of this name, or it has no `main`.
        ScriptError: the file raised an error while it was imported.
    """
    path = Path(name)
    if path.suffix != ".py":
        return example(name)
    if not path.is_file():
        raise ValueError(f"there is no file {path}; `lieint list` shows the examples")
    module = _import_file(path)
    if not callable(getattr(module, "main", None)):
        raise ValueError(f"{path} has no function `main`, which is what `lieint run` calls: see lieint list heavy_top")
    return module


@contextlib.contextmanager
def importable(name: str) -> Iterator[None]:
    """While a script is read and called, its folder is on the path, as it is for `python FILE`."""
    folder = [str(Path(name).absolute().parent)] if name.endswith(".py") else []
    sys.path[:0] = folder
    try:
        yield
    finally:
        for each in folder:
            sys.path.remove(each)


def is_example(script: Any) -> bool:
    """Whether a script belongs to the package."""
    return Path(script.__file__).is_relative_to(_PACKAGE)


def call(script: Any, function: Callable[[], None]) -> None:
    """Call the `main` of a script, with its arguments.

    Raises:
        ScriptError: an error of the script itself, rather than one that this package found in what it was given.
    """
    try:
        function()
    except Exception as error:
        raise _judged(error, Path(script.__file__)) from None
    except KeyboardInterrupt as stop:
        again = ": the same command with --resume" if "resume" in inspect.signature(script.main).parameters else ""
        raise KeyboardInterrupt(f"{stop}{again}" if stop.args else "") from None


def _import_file(path: Path) -> ModuleType:
    """The module of a file."""
    if path.stem in sys.modules and not hasattr(sys.modules[path.stem], _MARK):
        raise ValueError(f"{path} has the name of a module that is imported already: choose another name")
    spec = importlib.util.spec_from_file_location(path.stem, path.absolute())
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)  # where annotations are looked up
    setattr(module, _MARK, True)
    try:
        spec.loader.exec_module(module)
    except UnicodeDecodeError:
        raise ValueError(f"{path} is no script: it is not UTF-8 text") from None
    except SyntaxError as error:
        if "null bytes" in str(error):
            raise ValueError(f"{path} is no script: it has null bytes") from None
        raise ScriptError(error.with_traceback(None)) from None
    except Exception as error:
        raise _judged(error, path.absolute()) from None
    return module


def _judged(error: Exception, file: Path) -> Exception:
    """An error that came out of a script: as it is for one line, or as a `ScriptError` for a traceback.

    A ValueError or OSError raised below a call of this package is about what the script passed to it. Of a user's file
    its message gets the line of that call. Any other error of a user's file is the script's own.
    """
    if file.is_relative_to(_PACKAGE) or isinstance(error, BrokenPipeError):  # the reader of what it prints has gone
        return error
    own, line, inside = None, 0, False
    trace = error.__traceback__
    while trace is not None:
        name = Path(trace.tb_frame.f_code.co_filename)
        if name == file:
            own, line, inside = own or trace, trace.tb_lineno, False
        elif name.is_relative_to(_PACKAGE):
            inside = True
        trace = trace.tb_next
    if own is None:
        return error
    if inside and isinstance(error, OSError):
        return error
    if inside and isinstance(error, ValueError):
        cause = error.__cause__.__traceback__ if error.__cause__ is not None else None
        while cause is not None:  # what a function of the script raised, in the words of this package
            line = cause.tb_lineno if Path(cause.tb_frame.f_code.co_filename) == file else line
            cause = cause.tb_next
        return ValueError(f"{error} ({file.name}, line {line})")
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return error
    return ScriptError(error.with_traceback(own))
