"""The shapes in the signatures of the library, checked at run time by jaxtyping and beartype."""

import contextlib
import functools
import importlib
import inspect
import pkgutil
import types
from typing import Annotated, Union, get_args, get_origin

import jaxtyping
from beartype import beartype

import lieint_jax as li


@functools.cache
def modules():
    """All modules of the library, without the command, whose annotations are those of its options."""
    infos = pkgutil.walk_packages(li.__path__, "lieint_jax.")
    names = [info.name for info in infos if not info.name.startswith("lieint_jax.command")]
    return [importlib.import_module(name) for name in names]


@functools.cache
def shaped_functions():
    """Each function with a shape in its signature: the module or class that holds it, its name there, and itself."""
    holders = [*modules()]
    for module in modules():
        holders += [x for x in vars(module).values() if inspect.isclass(x) and x.__module__ == module.__name__]
    found = []
    for holder in dict.fromkeys(holders):
        own = holder.__name__ if inspect.ismodule(holder) else holder.__module__
        for name, member in vars(holder).items():
            function = plain(member)
            if function and function.__module__ == own and hints(function):
                found.append((holder, name, function))
    return found


def plain(member):
    """The Python function of a member of a module or class, or None; a property is represented by its getter."""
    function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
    return function if isinstance(function, types.FunctionType) and function is inspect.unwrap(function) else None


def hints(function):
    """The annotations of a function that have shapes, as types of jaxtyping, by parameter."""
    found = {}
    for name, text in function.__annotations__.items():
        with contextlib.suppress(NameError):  # of a name that only type checkers see
            annotation = eval(text, function.__globals__) if isinstance(text, str) else text
            if has_shape(annotation):
                found[name] = as_jaxtyping(annotation)
    return found


def has_shape(annotation):
    if get_origin(annotation) is Annotated:
        return annotation.__metadata__[-1] != "converted"  # what is given need not have the shape of the field
    is_union = get_origin(annotation) in (Union, types.UnionType, tuple)
    return is_union and any(has_shape(x) for x in get_args(annotation))


def as_jaxtyping(annotation):
    if get_origin(annotation) is Annotated:
        kind, shape = annotation.__metadata__
        return getattr(jaxtyping, kind)[annotation.__origin__, shape]
    if get_origin(annotation) in (Union, types.UnionType):
        return Union[tuple(map(as_jaxtyping, get_args(annotation)))]  # noqa: UP007
    if get_origin(annotation) is tuple:
        return tuple[tuple(map(as_jaxtyping, get_args(annotation)))]
    return annotation


def checked(function):
    """A copy of a function that raises `jaxtyping.TypeCheckError` where a shape is not the declared one."""
    copy = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__, copy.__annotations__ = function.__kwdefaults__, hints(function)
    copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
    return jaxtyping.jaxtyped(typechecker=beartype)(copy)


def check_all(monkeypatch):
    """Have every function of the library check its shapes; returns the set of the names of those that were called."""
    called = set()
    for holder, name, function in shaped_functions():
        new = recorded(checked(function), called)
        member = vars(holder)[name]
        if isinstance(member, property):
            new = property(new)
        elif isinstance(member, classmethod | staticmethod):
            new = type(member)(new)
        monkeypatch.setattr(holder, name, new)
        if inspect.ismodule(holder):
            for module in (li, *modules()):
                for other, value in list(vars(module).items()):
                    if value is function:
                        monkeypatch.setattr(module, other, new)
    return called


def recorded(function, called):
    @functools.wraps(function)
    def call(*arguments, **options):
        called.add(f"{function.__module__}.{function.__qualname__}")
        return function(*arguments, **options)

    return call
