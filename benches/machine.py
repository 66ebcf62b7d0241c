"""What a benchmark ran on, for the record."""

import datetime
import os
import pathlib
import platform
import re


def heading(what: str, facts: list[str]) -> str:
    """Returns a heading with the time, and the machine with further facts below it."""
    cpu = re.search(r"model name\s*: (.*)", pathlib.Path("/proc/cpuinfo").read_text())
    memory = re.search(r"MemTotal:\s*(\d+)", pathlib.Path("/proc/meminfo").read_text())
    known = [
        f"{cpu.group(1) if cpu else platform.machine()}, {os.cpu_count()} cores",
        f"{int(memory.group(1)) / 1e6 if memory else 0:.0f} GB",
        f"Linux {platform.release()}",
        f"load {os.getloadavg()[0]:.1f} at the start",
        f"Python {platform.python_version()}",
    ]
    now = datetime.datetime.now(datetime.UTC)
    return f"## {now:%Y-%m-%d %H:%M} UTC, {what}\n\n{', '.join(known + facts)}.\n"
