"""The studies that `lieint study NAME` runs: `toutatis`, `satellite`, `gyro`, `kappa`, `material`, `sensitivity`.

Each study is a module with three functions: `run` returns its result, `text` its report, and `draw` its picture.
`inference` is the common engine; it also runs a `Problem` of yours, `lieint study mine.py`.
"""
