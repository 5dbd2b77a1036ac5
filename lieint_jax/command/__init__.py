"""The command `lieint`."""
