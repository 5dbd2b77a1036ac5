"""API pages list a room's functions before its classes: `::: functions of NAME` and `::: classes of NAME` on a page.

Both stand for the public names: those of `__all__`, else what the module defines. To the classes belong those that
public functions return, such as the result of a measurement, also where they have no name in the room. After the build,
objects.inv, by which sites of other projects link to this one (intersphinx), must have every public name.
"""

import importlib
import inspect
import re
import typing
import zlib
from pathlib import Path

from mkdocs.exceptions import PluginError

DIRECTIVE = re.compile(r"^::: (functions|classes) of (\S+)$", re.M)
INTRODUCTION = """::: {}
    options:
      members: []
      show_root_heading: false
      show_root_toc_entry: false

"""


def on_page_markdown(markdown, **_):
    """Write each of these lines as mkdocstrings wants it."""
    return DIRECTIVE.sub(_members, markdown)


def _members(found):
    kind, name = found.groups()
    room = importlib.import_module(name)
    called = {getattr(room, x): x for x in _public(room) if _is_called(room, x)}  # a class with a name that is called
    chosen = [x for x in _public(room) if _is_called(room, x) == (kind == "functions")]
    chosen = [x for x in chosen if called.get(getattr(room, x), x) == x]
    members = "\n\n".join(
        [_member(room, x) for x in chosen] + [f"::: {x}" for x in _results(room) if kind == "classes"]
    )
    return INTRODUCTION.format(name) + members if kind == "functions" else members


def _results(room):
    """The paths of the classes that the functions of a room return, and that are not public themselves."""
    functions = [getattr(room, x) for x in _public(room) if inspect.isfunction(getattr(room, x))]
    returned = {x for function in functions for x in _classes(_return_type(function))}
    own = (x for x in returned if x.__module__.startswith(f"{room.__name__}._") and x.__name__ not in _public(room))
    return sorted(f"{x.__module__}.{x.__name__}" for x in own)


def _return_type(function):
    """What a function returns; None if only type checkers import a name in it."""
    try:
        return eval(str(function.__annotations__.get("return")), function.__globals__)
    except NameError:
        return None


def _classes(hint):
    """The classes that an annotation names."""
    return [hint] if inspect.isclass(hint) else [x for part in typing.get_args(hint) for x in _classes(part)]


def _member(room, name):
    found = getattr(room, name)
    if inspect.isclass(found) and found.__name__ != name:
        heading = f"    options:\n      heading: {name}\n      toc_label: {name}"
        return f'<a id="{name}"></a>\n\n::: {_path(room, name)}\n{heading}'
    return f'<a id="{name}"></a>\n\n::: {room.__name__}.{name}'


def _path(room, name):
    """The path by which mkdocstrings finds a name: of a class with a name that is called, that of the class."""
    found = getattr(room, name)
    own = found.__name__ if inspect.isclass(found) else name
    return f"{room.__name__}.{own}" if own in _public(room) else f"{found.__module__}.{own}"


def _is_called(room, name):
    return name[0].islower() or inspect.isfunction(getattr(room, name))  # K, E, … are functions, too


def _public(room):
    """The public functions and classes of a module."""
    own = [x for x, value in vars(room).items() if getattr(value, "__module__", None) == room.__name__]
    names = [x for x in getattr(room, "__all__", own) if not x.startswith("_") and x != "examples"]
    return [x for x in names if inspect.isclass(getattr(room, x)) or inspect.isfunction(getattr(room, x))]


def on_post_build(config):
    """Raise an error if a public name is not in objects.inv."""
    inventory = (Path(config.site_dir) / "objects.inv").read_bytes().split(b"\n", 4)[4]  # after four lines of comments
    listed = {line.split(" ")[0] for line in zlib.decompress(inventory).decode().splitlines()}
    face = importlib.import_module("lieint_jax")
    rooms = {f"lieint_jax.{x}": getattr(face, x) for x in face.__all__ if inspect.ismodule(getattr(face, x))}
    wanted = {_path(room, x) for room in (face, *rooms.values()) for x in _public(room)}
    if missing := sorted(wanted - listed):
        raise PluginError(f"objects.inv lacks {', '.join(missing)}")
