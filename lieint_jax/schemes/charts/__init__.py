"""The coordinates in which `gauss` and `extrapolate` integrate."""
