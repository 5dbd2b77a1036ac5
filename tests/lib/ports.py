"""Ports of this machine."""

import socket


def free_port():
    """The number of a port that no process uses."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return free.getsockname()[1]
