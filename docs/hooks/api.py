"""API pages list a room's functions before its classes: `::: functions of NAME` and `::: classes of NAME` on a page.

Both stand for the public names: those of `__all__`, else what the module defines. After the build, objects.inv, by
which sites of other projects link to this one (intersphinx), must have every public name.
"""

import importlib
import inspect
import re
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
    members = "\n\n".join(_member(room, x) for x in chosen)
    return INTRODUCTION.format(name) + members if kind == "functions" else members


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
