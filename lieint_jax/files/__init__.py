"""Files that people bring and take away. Each reader returns plain objects of this package.

| file | read | written |
|---|---|---|
"""

__all__: list[str] = []
