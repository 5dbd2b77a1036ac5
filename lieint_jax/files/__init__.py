"""Files that people bring and take away. Each reader returns plain objects of this package.

| file | read | written |
|---|---|---|
| logs of gyros and star trackers, CSV | `read_csv_log` | `write_csv` |
"""

from lieint_jax.files._csv_log import Log, read_csv_log, write_csv

__all__ = ["Log", "read_csv_log", "write_csv"]
