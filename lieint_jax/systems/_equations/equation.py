"""Equations of motion that systems inherit: what a scheme looks for in a system."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import ClassVar, TypeVar

from lieint_jax.core import System

_Function = TypeVar("_Function", bound=Callable[..., object])


def equation(function: _Function) -> _Function:
    """Mark a method as one of the equations of motion (a decorator).

    Schemes refuse a system that inherits the equations and overrides the method: its motion is another one.
    """
    function.is_equation = True  # pyright: ignore[reportFunctionMemberAccess]
    return function


class Equations(System):
    """An abstract system with its equations of motion, which systems inherit and schemes integrate.

    Attributes:
        noun: what such systems are, in messages.
    """

    noun: ClassVar[str]

    @classmethod
    def governs(cls, system: System) -> bool:
        """Whether a system moves by these equations."""
        return isinstance(system, cls) and cls.overridden(system) is None

    @classmethod
    def overridden(cls, system: System) -> str | None:
        """The name of one of these equations that a system which inherits them has overridden, or None."""
        for name in dir(cls):
            method = inspect.getattr_static(cls, name)
            if getattr(method, "is_equation", False) and inspect.getattr_static(type(system), name) is not method:
                return name
        return None
