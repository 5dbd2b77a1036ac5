"""Examples: one script for each simulation, study and figure of the paper, on public names only, to copy and change.

lieint list                                             all of them
lieint run toutatis --members 100                       or: python -m lieint_jax.examples.toutatis --members 100
lieint list toutatis > mine.py && lieint run mine.py    a copy of your own
"""
