"""Runs inside of jit: the times of steps, the loop over them, output, events and interpolation."""
