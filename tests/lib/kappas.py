"""One of the three κ's, chosen by numbers that are leaves, so that all three share a compilation."""

import jax

from lieint_jax.maps import KAPPAS, Kappa


def one_of(which, x):
    return sum(w * kappa(x) for w, kappa in zip(which, KAPPAS, strict=True))


def chosen(which):
    """The κ that a row of the unit matrix names."""
    return Kappa(jax.tree_util.Partial(one_of, which), "chosen")
