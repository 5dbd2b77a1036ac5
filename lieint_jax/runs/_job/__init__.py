"""What a run computes: its description, its loop and engine, devices and processes, its rows in memory."""
