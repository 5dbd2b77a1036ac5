"""The studies that `lieint study NAME` runs: `toutatis`, `satellite`, `gyro`, `kappa`, `material`, `sensitivity`.

Each is a module with `run`, which returns its result, `text`, which reports on it, and `draw`, which draws it.
"""
