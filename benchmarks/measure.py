"""Times of calls, side by side: all in turn, many rounds, minimum and median. If not said otherwise, it is
the processor's time, that of all threads, which is the time that passes on one core with nothing else to do."""

import contextlib
import os
import statistics
import time

import torch

ROUNDS = 5
CORES = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
SAMPLE_SECONDS = 0.02  # what a reading takes at least; a call is repeated to reach it


def keep_to_one_core():
    """XLA has no switch that holds, so the process keeps to one core, whatever a library's pool does."""
    if CORES:
        os.sched_setaffinity(0, {max(CORES)})


@contextlib.contextmanager
def threads(count):
    """torch's threads within it; more than one may use all cores that the process was given."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    if CORES and count > 1:
        kept = os.sched_getaffinity(0)
        os.sched_setaffinity(0, CORES)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        if CORES and count > 1:
            os.sched_setaffinity(0, kept)


def interleaved(calls, rounds=ROUNDS, sample_seconds=SAMPLE_SECONDS, clock=time.process_time):
    """Seconds a call, {name: {"min": …, "median": …}}, of callables {name: call} that end when their work
    has ended. Neighbours on the machine disturb all of them alike."""
    repeats = {}
    for name, call in calls.items():
        call()  # warm-up: caches, workspaces, compilers
        repeats[name] = max(1, round(sample_seconds / max(_seconds(call, 1, clock), 1e-7)))
    readings = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            readings[name].append(_seconds(call, repeats[name], clock))
    return {name: {"min": min(r), "median": statistics.median(r)} for name, r in readings.items()}


def _seconds(call, repeats, clock):
    started = clock()
    for _ in range(repeats):
        call()
    return (clock() - started) / repeats
