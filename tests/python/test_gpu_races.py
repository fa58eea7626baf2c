"""ThreadSanitizer over the kernels' text: the threads of a block as fibers that only barriers and shuffles put into an
order. What two of them may touch at the same time is reported, whether or not it changes a result."""

import os
import pathlib
import subprocess
import sys

import pytest
from fibers import ROOT, barriers

FOUND = 66


def sanitizer():
    found = subprocess.run(["c++", "-print-file-name=libtsan.so"], capture_output=True, text=True, check=True).stdout
    return pathlib.Path(found.strip()).resolve()


def run(left_out):
    environment = {
        **os.environ,
        "LD_PRELOAD": str(sanitizer()),
        "TSAN_OPTIONS": f"halt_on_error=1:exitcode={FOUND}:suppressions={ROOT}/tests/fibers/tsan.supp",
        "PRDP_FIBERS_TSAN": "1",
    }
    command = [sys.executable, "-W", "ignore", str(ROOT / "tests/python/races.py"), str(left_out)]
    return subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False)


def test_no_two_threads_touch_a_number_at_the_same_time():
    done = run(0)
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.mark.parametrize("barrier", [2, -1], ids=["in a sum", "before a product"])
def test_a_barrier_that_is_missing_is_reported(barrier):
    done = run(barriers()[barrier])
    assert done.returncode == FOUND and "data race" in done.stderr, done.stderr[-3000:]
