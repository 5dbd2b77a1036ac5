"""Laws that change the torque of another law."""

from __future__ import annotations

from lieint_jax.types import Law

__all__ = ["ModifiedLaw"]


class ModifiedLaw(Law):
    """A law without an internal state whose torque is that of another law, changed by its `mean`.

    Its axes, what it reads, its symmetry and its label are those of the other law. A subclass is decorated with
    `li.pytree`, has a field `law` and defines `mean`.
    """

    law: Law

    @property
    def frame(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.law.frame

    @property
    def symmetric(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.law.symmetric

    @property
    def reads(self) -> str | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.law.reads

    @property
    def label(self) -> str:
        return self.law.label
