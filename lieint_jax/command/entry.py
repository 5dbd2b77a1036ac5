"""The command `lieint` as it is installed: an interrupt ends it in one line, even while JAX is imported.

It is installed as the module `lieint_command`, outside of the package, of which no module can be imported before JAX.
"""

import sys


def main() -> int:
    """Run the command; return its exit code, 130 after an interrupt."""
    try:
        from lieint_jax.command import cli

        return cli.main()
    except KeyboardInterrupt:
        print("lieint: interrupted", file=sys.stderr)
        return 130
