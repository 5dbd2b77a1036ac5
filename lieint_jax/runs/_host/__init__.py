"""Runs on the host: `Run`, and what makes, extends, saves and submits one."""
