"""Seconds and peak memory of a call, in a process that does nothing else.

Seconds are the processor's time, that of all threads: on the one core that the process keeps to, it is the time that
passes if nothing else runs there. Memory is the growth of the peak resident set over one call. Before it, freed pages
are handed back to the system and Linux's mark of the peak is reset, so that neither imports nor compilation count."""

import ctypes
import statistics
import time
from pathlib import Path

from benchmarks.memory import resident

TRIALS = 3


def of(call):
    """{"bytes", "seconds" (the least of the trials), "median_seconds"}, and the answer. The first call is not timed: it
    warms up and tells the memory."""
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")
    before = resident("VmRSS")
    answer = call()
    grown = max(0, resident("VmHWM") - before)
    trials = [_seconds(call) for _ in range(TRIALS)]
    return {"bytes": grown, "seconds": min(trials), "median_seconds": statistics.median(trials)}, answer


def _seconds(call):
    started = time.process_time()
    call()
    return time.process_time() - started
